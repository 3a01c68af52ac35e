"""RLlib's DQN; it pins another Gymnasium, and so lives in an environment of its own."""

import ray
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune import register_env

from tests.benchmarks.contest import Finding, Heat, Lap, compete, float_env, policy_of, target_every_env_steps


def algorithm(heat: Heat):
    config = heat.config
    register_env("contest", lambda _: float_env(config.env))
    buffer = {"type": "EpisodeReplayBuffer", "capacity": config.replay_capacity}
    return (
        DQNConfig()
        .environment("contest")
        .env_runners(num_env_runners=1, num_envs_per_env_runner=heat.envs)
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=list(config.hidden_sizes), fcnet_activation="relu", head_fcnet_hiddens=[]
            )
        )
        .training(
            lr=[[0, config.learning_rate], [config.learning_rate_decay_env_steps, config.learning_rate_end]],
            gamma=config.decision_discount,
            train_batch_size_per_learner=config.batch_size,
            num_steps_sampled_before_learning_starts=config.min_replay,
            target_network_update_freq=target_every_env_steps(config),
            double_q=True,
            dueling=False,
            n_step=config.n_step,
            epsilon=[[0, config.epsilon_start], [config.epsilon_decay_env_steps, config.epsilon_end]],
            training_intensity=config.samples_per_insert,
            replay_buffer_config=buffer,
        )
        .reporting(min_sample_timesteps_per_iteration=1, min_time_s_per_iteration=1)
        .debugging(seed=config.seed)
        .build_algo()
    )


def train(heat: Heat) -> Finding:
    ray.init(
        num_cpus=3,
        include_dashboard=False,
        object_store_memory=1_000_000_000,
        log_to_driver=False,
        logging_level="ERROR",
    )
    made = algorithm(heat)
    lap = Lap(heat)
    over = False
    while not over:
        result = made.train()
        env_steps = int(result["env_runners"].get("num_env_steps_sampled_lifetime", 0))
        trained = result.get("learners", {}).get("__all_modules__", {}).get("num_env_steps_trained_lifetime", 0)
        over = lap.over(env_steps, int(trained) // heat.config.batch_size, lambda: policy_of(made.get_module()))
    made.stop()
    ray.shutdown()
    return lap.finding()


if __name__ == "__main__":
    compete(train)
