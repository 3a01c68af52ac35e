"""TorchRL's parts for DQN, put together as in its own example (`sota-implementations/dqn`)."""

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymWrapper, SerialEnv
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate

from tests.benchmarks.contest import Finding, Heat, Lap, compete, float_env, policy_of, rhythm


def train(heat: Heat) -> Finding:
    config = heat.config
    torch.set_num_threads(heat.threads)
    torch.manual_seed(config.seed)

    def make():
        return GymWrapper(float_env(config.env), categorical_action_encoding=True)

    env = SerialEnv(heat.envs, make)
    env.set_seed(config.seed)
    size, actions = env.observation_spec["observation"].shape[-1], env.full_action_spec_unbatched["action"].space.n
    network = MLP(
        in_features=size, out_features=actions, num_cells=list(config.hidden_sizes), activation_class=torch.nn.ReLU
    )
    actor = QValueActor(network, in_keys=["observation"], spec=env.full_action_spec_unbatched["action"])
    exploring = EGreedyModule(
        annealing_num_steps=config.epsilon_decay_env_steps,
        eps_init=config.epsilon_start,
        eps_end=config.epsilon_end,
        spec=env.full_action_spec_unbatched["action"],
    )
    beat = rhythm(config, heat.envs)
    frames = heat.envs * beat.vector_steps
    collector = Collector(
        env,
        TensorDictSequential(actor, exploring),
        frames_per_batch=frames,
        total_frames=config.total_env_steps,
        init_random_frames=config.min_replay,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(config.replay_capacity), batch_size=config.batch_size, prefetch=2
    )
    loss_module = DQNLoss(actor, loss_function="smooth_l1", delay_value=True, double_dqn=True)
    loss_module.make_value_estimator(gamma=config.decision_discount)
    target = HardUpdate(loss_module, value_network_update_interval=config.target_update_interval)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=config.learning_rate)
    lap, env_steps, updates = Lap(heat), 0, 0
    for data in collector:
        env_steps += data.numel()
        exploring.step(data.numel())
        buffer.extend(data.reshape(-1))
        if env_steps >= config.min_replay:
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate_at(env_steps)
            for _ in range(beat.updates):
                loss_module(buffer.sample())["loss"].backward()
                torch.nn.utils.clip_grad_norm_(loss_module.parameters(), config.max_gradient_norm)
                optimizer.step()
                optimizer.zero_grad()
                target.step()
                updates += 1
        if lap.over(env_steps, updates, lambda: policy_of(network)):
            break
    collector.shutdown()
    return lap.finding()


if __name__ == "__main__":
    compete(train)
