"""The config of a run: one flat frozen dataclass beside that of the world, checked when it is made."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.policy.baselines import METHOD_RULES
from actors.rollout.env_spec import EnvSpec
from actors.rollout.exploration import Exploration, linear_schedule
from sim_core import ENV_ID
from sim_core.checks import ConfigError, check_fields, require
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.plugins import METHODS, SCENES, check_unchanged, identity


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """All settings that decide what a run learns, and the engine and device; other placement and storage are not here.

    Raises:
      ConfigError: a value is out of range or two values contradict each other.
    """

    world: WorldConfig = field(default_factory=WorldConfig)
    """The setup and its world (used with our own env_id)."""
    env_id: str = ENV_ID
    """Gymnasium id of an environment with Box observations and Discrete actions."""
    seed: int = 0
    """Seed of every random stream of the run."""
    engine: Literal["ray", "process"] = "ray"
    """Ray actors, or everything in one process (deterministic, for tests and debugging)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the learner's networks; `auto` takes CUDA if available, else the CPU."""
    total_env_steps: int = 3_000_000
    """Env steps to train for, over all workers."""

    setups: tuple[str, ...] = ()
    """Setups that one policy learns at once: `all` of the dissertation's 25, or ROBOTSxGROUPS each, with a share of the
    environments where they are not equal (10x2 25x8:2); by default that of `robots` and `groups` alone."""

    workers: int = 1
    """Rollout workers."""
    envs_per_worker: int = 64
    """Environments of one rollout worker, stepped as a batch. Where several robots of a world learn, each is one: as
    many whole worlds as fit, at least one of each setup."""
    steps_per_block: int = 128
    """Env steps of each environment in a block of transitions."""
    exploration: Literal["schedule", "ladder"] = "schedule"
    """One decaying epsilon for all workers, or Ape-X's ladder of a constant one per worker (Horgan et al. 2018)."""
    epsilon_start: float = 1.0
    """Schedule: exploration rate at the start."""
    epsilon_end: float = 0.05
    """Schedule: exploration rate after the decay (Table 3.2)."""
    epsilon_decay_env_steps: int = 400_000
    """Schedule: env steps of the linear decay."""
    ladder_base: float = 0.4
    """Ladder: exploration rate of the worker that explores most."""
    ladder_exponent: float = 7.0
    """Ladder: how steeply the rate falls from worker to worker (alpha)."""

    replay_shards: int = 1
    """Replay shards."""
    replay_placement: Literal["learner", "actors"] = "learner"
    """Shards in the learner's process, or each as its own Ray actor."""
    replay_capacity: int = 500_000
    """Capacity of all shards together, in transitions."""
    min_replay: int = 20_000
    """Transitions stored before the first update."""
    samples_per_insert: float = 2.0
    """How often a transition is sampled on average (as in Reverb's rate limiter)."""
    replay: Literal["uniform", "prioritised"] = "uniform"
    """Transitions sampled uniformly, or in proportion to |TD error| ** priority_exponent (Schaul et al. 2016)."""
    priority_exponent: float = 0.6
    """Prioritised: 0 samples uniformly, 1 in proportion to |TD error| (alpha)."""
    importance_exponent_start: float = 0.4
    """Prioritised: exponent of the importance weights at the start (beta)."""
    importance_exponent_end: float = 1.0
    """Prioritised: beta after the schedule; 1 corrects the whole sampling bias."""
    importance_exponent_env_steps: int = 3_000_000
    """Prioritised: env steps of beta's linear schedule."""

    algorithm: Literal["double_dqn", "dqn"] = "double_dqn"
    """TD target: Double DQN (Algorithm 2) or DQN (Algorithm 1)."""
    hidden_sizes: tuple[int, ...] = (128, 128)
    """Widths of the Q-network's hidden layers."""
    network: Literal["plain", "dueling", "pooled"] = "plain"
    """One stream; two, for state value and advantages, from the last hidden layer on (Wang et al. 2016); or, for in and
    out, layers that the other groups' rows share, and their maximum (Zaheer et al. 2017); the first width is theirs."""
    discount: float = 0.99
    """Discount per decision, gamma (the dissertation's lambda = 0.001 cannot be a discount)."""
    discount_time_s: float = 0.0
    """Time constant of the discount, s, in place of `discount`: exp(-t / discount_time_s) means the same whatever a
    decision lasts; 0: none."""
    n_step: int = 3
    """Env steps that a transition spans (n-step return)."""
    random_turns: bool = False
    """Data augmentation: every sampled transition is turned, with its heading, by a random turn of the method's."""
    batch_size: int = 256
    """Transitions per update."""
    updates_per_call: int = 64
    """Updates between two publications of weights to the rollout workers."""
    learning_rate: float = 1e-3
    """Adam's learning rate at the start (the dissertation's lambda)."""
    learning_rate_end: float = 1e-4
    """Adam's learning rate after the decay."""
    learning_rate_decay_env_steps: int = 3_000_000
    """Env steps of the decay (for a constant rate: learning_rate_end = learning_rate)."""
    learning_rate_schedule: Literal["linear", "cosine"] = "linear"
    """Linear decay, or half a cosine."""
    target_update: Literal["hard", "soft"] = "hard"
    """Copy the online network to the target network at intervals, or blend it in after every update (Polyak)."""
    target_update_interval: int = 500
    """Hard: updates between two copies (C)."""
    target_update_rate: float = 0.005
    """Soft: share of the online network blended in per update (tau)."""
    policy_average_updates: int = 0
    """Time constant, in updates, of the moving average of the weights, which acts, is evaluated and saved; 0: none."""
    loss: Literal["huber", "mse"] = "huber"
    """Huber loss of the TD error (quadratic up to 1, linear beyond), or mean squared error."""
    teacher: str = "none"
    """Rule of the method (greedy, field) whose action's value shall exceed the others' in every sampled state, beside
    learning (Hester et al. 2018, Eq. 5); or none."""
    teacher_margin: float = 0.1
    """Teacher: by how much its action's value shall exceed the others'."""
    teacher_weight: float = 1.0
    """Teacher: weight of this loss at the start."""
    teacher_weight_end: float = 0.1
    """Teacher: weight after the decay."""
    teacher_decay_env_steps: int = 3_000_000
    """Teacher: env steps of the linear decay."""
    max_gradient_norm: float = 10.0
    """Gradients with a larger norm are scaled down to it."""
    gradients: Literal["by_hand", "autograd"] = "by_hand"
    """Hand-written gradients (compiled where possible), or PyTorch's autograd: equal up to rounding."""

    eval_every_env_steps: int = 250_000
    """Env steps between two evaluations during training."""
    eval_episodes: int = 100
    """Greedy episodes per evaluation during training."""
    final_eval_episodes: int = 1_000
    """Greedy episodes of the final evaluation."""
    final_eval_first_seed: int = 2_000_000_000
    """Seed of the first of them; each later one adds 1."""
    log_every_env_steps: int = 20_000
    """Env steps between two rows of training metrics."""
    checkpoint_every_env_steps: int = 500_000
    """Env steps between two checkpoints."""
    keep_checkpoints: int = 2
    """How many of the newest checkpoints to keep."""

    def __post_init__(self) -> None:
        check_fields(self)
        _check_ranges(self)
        _check_setups(self)
        _check_pairs(self)
        _check_discount(self)
        _check_network(self)
        _check_augmentation(self)
        _check_teacher(self)

    @cached_property
    def env(self) -> EnvSpec:
        """The environment of rollout workers and evaluators."""
        return EnvSpec(self.env_id, self.world, tuple(setup_shares(self)))

    @property
    def title(self) -> str:
        """What is learned, for users, such as `sensor 10r×2g`, `sensor in 25 setups` or an environment's id."""
        if not self.env.is_swarm:
            return self.env_id
        setups, learners = len(self.env.worlds), self.world.learners
        several = "" if learners == ONE_LEARNER else f", learners {learners}"
        return f"{self.world.method_name} {self.world.setup if setups == 1 else f'in {setups} setups'}{several}"

    @property
    def name(self) -> str:
        """Name for users, such as `sensor 10r×2g s0`."""
        return f"{self.title} s{self.seed}"

    @property
    def epsilon_settings(self) -> Exploration:
        """Exploration settings of the rollout workers."""
        return Exploration(
            self.exploration,
            self.epsilon_start,
            self.epsilon_end,
            self.epsilon_decay_env_steps,
            self.ladder_base,
            self.ladder_exponent,
        )

    def learning_rate_at(self, env_steps: int) -> float:
        """Adam's learning rate after `env_steps` env steps, a function of a counter that checkpoints hold."""
        done = min(1.0, env_steps / self.learning_rate_decay_env_steps)
        if self.learning_rate_schedule == "cosine":
            done = (1.0 - math.cos(math.pi * done)) / 2.0
        return self.learning_rate + done * (self.learning_rate_end - self.learning_rate)

    def importance_exponent_at(self, env_steps: int) -> float:
        """Exponent of the importance weights after `env_steps` env steps (beta)."""
        start, end = self.importance_exponent_start, self.importance_exponent_end
        return linear_schedule(start, end, self.importance_exponent_env_steps, env_steps)

    def teacher_weight_at(self, env_steps: int) -> float:
        """Weight of the losses of the teacher's actions after `env_steps` env steps."""
        start, end = self.teacher_weight, self.teacher_weight_end
        return linear_schedule(start, end, self.teacher_decay_env_steps, env_steps)

    @property
    def decision_discount(self) -> float:
        """Discount of a decision, gamma."""
        if self.discount_time_s == 0:
            return self.discount
        return math.exp(-self.world.decision_interval_steps * self.world.time_step_s / self.discount_time_s)

    @property
    def policy_sizes(self) -> tuple[int, ...]:
        """Hidden sizes of the plain network that acts (see `actors.policy.network.snapshot`)."""
        *shared, last = self.hidden_sizes
        return (*shared, 2 * last) if self.network == "dueling" else self.hidden_sizes

    @property
    def block_env_steps(self) -> int:
        """Env steps in one block; the most where several robots of a world learn and some wait for its end."""
        return sum(self.env.counts(self.envs_per_worker)) * self.steps_per_block


WHERE = ("engine", "device")
"""Settings that place a run and have no influence on what it learns."""
AT_LEAST_ONE = (
    "total_env_steps workers envs_per_worker steps_per_block epsilon_decay_env_steps "
    "learning_rate_decay_env_steps importance_exponent_env_steps teacher_decay_env_steps replay_shards replay_capacity "
    "min_replay n_step batch_size updates_per_call target_update_interval eval_every_env_steps eval_episodes "
    "final_eval_episodes log_every_env_steps checkpoint_every_env_steps keep_checkpoints"
).split()


def _check_ranges(config: RunConfig) -> None:
    for name in AT_LEAST_ONE:
        require(getattr(config, name) >= 1, f"{name} must be at least 1, not {getattr(config, name)}")
    require(0 <= config.seed < 2**31, f"seed must be in 0..{2**31 - 1}, not {config.seed}")
    last = 2**32 - 1 - config.final_eval_episodes
    require(
        0 <= config.final_eval_first_seed <= last,
        f"final_eval_first_seed must be in 0..{last}, not {config.final_eval_first_seed}",
    )
    shares = "epsilon_start epsilon_end ladder_base priority_exponent importance_exponent_start importance_exponent_end"
    for name in shares.split():
        require(0 <= getattr(config, name) <= 1, f"{name} must be between 0 and 1, not {getattr(config, name)}")
    require(0 < config.discount <= 1, f"discount must be in (0, 1], not {config.discount}")
    for name in ("samples_per_insert", "learning_rate", "learning_rate_end", "max_gradient_norm"):
        require(getattr(config, name) > 0, f"{name} must be greater than 0, not {getattr(config, name)}")
    rate = config.target_update_rate
    require(0 < rate <= 1, f"target_update_rate must be in (0, 1], not {rate}")
    require(
        config.policy_average_updates >= 0,
        f"policy_average_updates must not be negative, not {config.policy_average_updates}",
    )
    for name in ("teacher_margin", "teacher_weight", "teacher_weight_end"):
        require(getattr(config, name) >= 0, f"{name} must not be negative, not {getattr(config, name)}")
    require(config.ladder_exponent >= 0, f"ladder_exponent must not be negative, not {config.ladder_exponent}")
    sizes = config.hidden_sizes
    require(
        isinstance(sizes, tuple) and len(sizes) > 0 and all(type(size) is int and size >= 1 for size in sizes),
        f"hidden_sizes must be one or more widths of at least 1, not {sizes!r}",
    )


def _check_pairs(config: RunConfig) -> None:
    require(
        config.replay_capacity >= config.replay_shards * config.block_env_steps,
        f"replay_capacity ({config.replay_capacity}) must hold a block of {config.block_env_steps} transitions "
        f"in each of {config.replay_shards} shards",
    )
    require(
        config.min_replay <= config.replay_capacity,
        f"min_replay ({config.min_replay}) must not exceed replay_capacity ({config.replay_capacity})",
    )
    require(
        config.min_replay < config.total_env_steps,
        f"min_replay ({config.min_replay}) must be below total_env_steps ({config.total_env_steps}), "
        "or nothing is learned",
    )


SETUP = re.compile(r"([1-9][0-9]*)x([1-9][0-9]*)(?::([0-9.]+))?")
"""A setup on the command line: robots per group, groups, share."""


def setup_shares(config: RunConfig) -> list[tuple[WorldConfig, float]]:
    """The world of each of `setups`, and its share of the environments.

    Raises:
      ConfigError: a setup is no setup, named twice or impossible.
    """
    found: dict[tuple[int, int], float] = {}
    for text in config.setups:
        if text == "all":
            named = {(robots, groups): 1.0 for robots in ROBOTS for groups in GROUPS}
        else:
            parts = SETUP.fullmatch(text)
            require(parts is not None, f"setups must be `all` or ROBOTSxGROUPS, as in 10x2 or 25x8:2, not {text!r}")
            assert parts is not None
            share = _share(parts[3] or "1")
            require(0 < share < math.inf, f"the share of a setup must be greater than 0, not {text!r}")
            named = {(int(parts[1]), int(parts[2])): share}
        for setup, share in named.items():
            require(setup not in found, f"setups name {setup[0]}x{setup[1]} twice; name each once")
            found[setup] = share
    return [(replace(config.world, robots=r, groups=g), share) for (r, g), share in found.items()]


def _share(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _check_network(config: RunConfig) -> None:
    if config.network == "pooled":
        require(
            config.env.row_size > 0,
            f"network must be plain or dueling for {config.title}, whose observations are no rows of groups; pooled is "
            "for methods in and out",
        )


def _check_discount(config: RunConfig) -> None:
    if config.discount_time_s != 0:
        require(
            config.env.is_swarm,
            f"discount_time_s must be 0 for {config.env_id}, whose steps have no duration; set discount",
        )
        require(
            config.discount_time_s > 0 and config.decision_discount > 0,
            f"discount_time_s must be 0 or long enough for a discount above 0, not {config.discount_time_s}",
        )


def _check_augmentation(config: RunConfig) -> None:
    if config.random_turns:
        require(config.env.is_swarm, f"random_turns are for our own environment, not for {config.env_id}")
        require(
            config.world.method_class.turns(config.world) > 1,
            f"random_turns must be False for method {config.world.method_name} with these settings: its state does not "
            "turn with the world, or does so by itself",
        )


def _check_teacher(config: RunConfig) -> None:
    if config.teacher != "none":
        require(config.env.is_swarm, f"teacher must be none for {config.env_id}: rules are for our own environment")
        rules = ", ".join(config.world.method_class.rules(config.world))
        require(
            config.teacher in METHOD_RULES and config.teacher in rules,
            f"teacher must be none or a rule of method {config.world.method_name}, which has: {rules or 'none'}; not "
            f"{config.teacher}",
        )


def _check_setups(config: RunConfig) -> None:
    require(
        isinstance(config.setups, tuple) and all(isinstance(text, str) for text in config.setups),
        f"setups must be a list of texts such as 10x2, not {config.setups!r}",
    )
    if not config.setups:
        return
    require(config.env.is_swarm, f"setups are those of our own environment, not of {config.env_id}")
    worlds = config.env.worlds
    groups = {world.groups for world in worlds}
    sizes = {len(world.method_class.observation_names(world)) for world in worlds}
    require(
        len(sizes) == 1,
        f"setups must all have equally many groups, not {sorted(groups)}: the state of method "
        f"{config.world.method_name} grows with the groups, and one network takes states of one size; for in and out, "
        f"group_rows = {max(groups)} pads it",
    )
    require(
        config.envs_per_worker >= len(worlds),
        f"envs_per_worker ({config.envs_per_worker}) must be at least the number of setups ({len(worlds)}), "
        "or a rollout worker never plays some of them",
    )


def to_dict(config: RunConfig) -> dict[str, Any]:
    """The config as nested plain values, for JSON and TOML."""
    return dataclasses.asdict(config)


def flat_params(config: RunConfig) -> dict[str, Any]:
    """The whole config in one flat dict; no field of the run and the world share a name."""
    values = to_dict(config)
    world: dict[str, Any] = values.pop("world")
    return values | world


def user_files(config: RunConfig) -> dict[str, str]:
    """Texts of a user's own files by `SETTING/NAME`, such as `method/my_method.py`."""
    found = {}
    for kind in (METHODS, SCENES):
        name, text = getattr(config.world, kind.setting), config.world.source(kind)
        if text:
            found[f"{kind.setting}/{identity(kind, name).rpartition(':')[0]}"] = text
    return found


def check_files_unchanged(config: RunConfig) -> None:
    """Raises ConfigError if a user's own file, where it is still there, is no longer the one that the config holds."""
    for kind in (METHODS, SCENES):
        check_unchanged(kind, getattr(config.world, kind.setting), config.world.source(kind))


def from_dict(values: dict[str, Any]) -> RunConfig:
    """The config in nested plain values; missing keys have their defaults.

    Raises:
      ConfigError: a key is unknown, or a value is invalid.
    """
    world = values.get("world", {})
    require(isinstance(world, dict), f"world must be a section [world] of settings, not {world!r}")
    for given, known, where in (
        (values, RunConfig.__dataclass_fields__, "config"),
        (world, WorldConfig.__dataclass_fields__, "config section [world]"),
    ):
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise ConfigError(f"unknown key {unknown[0]!r} in the {where}; `shoal train --help` lists the keys")
    plain = {**values, "world": WorldConfig(**world)}
    for name in ("hidden_sizes", "setups"):
        if isinstance(plain.get(name), list):
            plain[name] = tuple(plain[name])
    return RunConfig(**plain)


UNCOUNTED = {
    "discount_time_s": 0.0,
    "speed_levels": 1,
    "learners": ONE_LEARNER,
    "ended_learners": "fl-orca",
    "kinematics": "holonomic",
    "turn_rate_limit_deg_s": 180.0,
    "acceleration_limit_m_s2": 2.0,
    "track_steps": 0,
}
"""Settings that hashes leave out at these values, whatever the defaults are later: runs from before there were such
settings keep their hashes."""


def identity_dict(config: RunConfig) -> dict[str, Any]:
    """The config as plain values for hashes: a user's own files count by their names and texts, not their folders."""
    values = to_dict(config)
    for kind in (METHODS, SCENES):
        values["world"][kind.setting] = identity(kind, values["world"][kind.setting])
    for section in (values, values["world"]):
        for name in [name for name, value in UNCOUNTED.items() if section.get(name) == value]:
            del section[name]
    values["world"]["sources"] = tuple((os.path.basename(path), text) for path, text in config.world.sources)
    return values


def config_hash(config: RunConfig) -> str:
    """Hash of a config, 12 hex digits; the length of the training and its placement do not count."""
    values = identity_dict(config)
    for name in ("total_env_steps", *WHERE):
        values.pop(name)
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
