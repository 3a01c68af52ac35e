"""Every metric of a run under the name that Prometheus knows it by: one table, for code, dashboards and docs.

The journal's rows are the only measurement; `ray_metrics` passes them on under these names. Ray puts `ray_` before each
and Prometheus' `_total` behind a counter.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

ENV_STEPS = "env_steps"
"""Stands for a training row's own count of env steps."""


class Exported(NamedTuple):
    """One metric: its name in the journal and in Ray, its kind, and what the operator's page says of it."""

    journal: str
    name: str
    kind: Literal["gauge", "counter"]
    unit: str
    meaning: str
    healthy: str

    @property
    def series(self) -> str:
        """The name that queries use."""
        return f"ray_{self.name}_total" if self.kind == "counter" else f"ray_{self.name}"


def _gauge(journal: str, name: str, unit: str, meaning: str, healthy: str) -> Exported:
    return Exported(journal, f"shoal_{name}", "gauge", unit, meaning, healthy)


def _counter(journal: str, name: str, unit: str, meaning: str, healthy: str) -> Exported:
    return Exported(journal, f"shoal_{name}", "counter", unit, meaning, healthy)


THROUGHPUT = (
    _counter(ENV_STEPS, "env_steps", "env steps", "made by the run, those before a resume included", "grows"),
    _counter("account/updates", "updates", "updates", "made by the run, those before a resume included", "grows"),
    _counter("account/episodes", "episodes", "episodes", "that ended in training", "grows"),
    _gauge("speed/env_steps_per_s", "env_steps_per_second", "env steps/s", "since the last row", "steady"),
    _gauge("speed/updates_per_s", "updates_per_second", "updates/s", "since the last row", "steady"),
)

LEARNING = (
    _gauge("train/epsilon", "epsilon", "share", "exploration rate of the last block", "falls to `epsilon_end`"),
    _gauge(
        "train/success_rate",
        "train_success_rate",
        "share",
        "training episodes since the last row that ended in the goal",
        "rises, below the evaluated one while epsilon is large",
    ),
    _gauge("train/return", "train_return", "reward", "mean return of those episodes", "rises"),
    _gauge("train/episode_length", "train_episode_length", "env steps", "their mean length", "below the horizon"),
    _gauge("train/loss", "loss", "squared reward", "mean Huber loss", "small, without growth"),
    _gauge("train/td_error", "td_error", "reward", "mean absolute TD error", "small, without growth"),
    _gauge("train/q_mean", "q_mean", "reward", "mean action value in the minibatches", "bounded by the best return"),
)


def _evaluated() -> tuple[Exported, ...]:
    ends = {"low": "lower end of its 95 % interval", "high": "upper end of its 95 % interval"}
    rates = {
        "success": ("greedy episodes on fixed seeds that ended in the goal", "rises"),
        "lost": ("of them lost", "falls"),
        "captured": ("of them captured", "falls"),
        "collision": ("of them collided", "falls"),
        "timeout": ("of them at the horizon", "falls"),
    }
    rows = []
    for name, (meaning, healthy) in rates.items():
        rows.append(_gauge(f"eval/{name}_rate", f"eval_{name}_rate", "share", meaning, healthy))
        rows += [
            _gauge(f"eval/{name}_rate_{end}", f"eval_{name}_rate_{end}", "share", text, "")
            for end, text in ends.items()
        ]
    rows.append(_gauge("eval/return", "eval_return", "reward", "mean return of the evaluated episodes", "rises"))
    rows += [
        _gauge(f"eval/return_{end}", f"eval_return_{end}", "reward", f"{text}, in environments without outcomes", "")
        for end, text in ends.items()
    ]
    length = _gauge("eval/episode_length", "eval_episode_length", "env steps", "their mean length", "below the horizon")
    return (*rows, length)


EVALUATION = _evaluated()

REPLAY = (
    _gauge("replay/size", "replay_size", "transitions", "held by all shards together", "grows to `replay_capacity`"),
    _gauge(
        "replay/samples_per_insert",
        "samples_per_insert",
        "ratio",
        "how often a transition has been sampled on average",
        "approaches the setting: within 5 % of it after 20 x `min_replay` transitions",
    ),
    _gauge(
        "policy/staleness_updates",
        "broadcast_lag_updates",
        "updates",
        "age of the acting weights when a block is stored",
        "a few calls of updates (`updates_per_call`)",
    ),
    _gauge(
        "policy/staleness_s",
        "broadcast_lag_seconds",
        "s",
        "the same in seconds, clocks of two nodes compared",
        "a few seconds",
    ),
    _counter(
        "account/waits_to_insert",
        "waits_to_insert",
        "rounds",
        "of the loop in which a rollout worker had to wait for the learner",
        "grows where the learner is the slower side",
    ),
    _counter(
        "account/waits_to_sample",
        "waits_to_sample",
        "rounds",
        "of the loop in which the learner had to wait for transitions",
        "grows where the rollout workers are the slower side",
    ),
)


def _share(part: str, does: str, meaning: str, healthy: str) -> Exported:
    name = f"{part.split()[-1]}_{does}"
    return _gauge(f"time/{name}", f"time_{name}", "share", f"of the {part}'s time: {meaning}", healthy)


_LIMITS = "high where it limits the run"
_WAITS = "waiting for the training loop, and for checkpoints"
TIMES = (
    _share("rollout worker", "acts", "stepping environments", _LIMITS),
    _share("rollout worker", "stores", "waiting for a shard's reply to a push", "small"),
    _share(
        "rollout worker",
        "waits",
        _WAITS,
        "high where the learner limits the run",
    ),
    _share("learner", "updates", "making updates", _LIMITS),
    _share("learner", "samples", "drawing transitions, or waiting for shards", "small"),
    _share("learner", "publishes", "handing out weights and TD errors", "small"),
    _share("learner", "stores", "storing the rollout workers' blocks, where the shards are its own", "small"),
    _share(
        "learner",
        "waits",
        _WAITS,
        "high where the rollout workers limit the run",
    ),
)

# Ray shows a counter once it counts: what should stay 0 is a gauge.
ACCOUNTS = (
    _counter("account/produced", "transitions_produced", "transitions", "made by rollout workers", "stored + dropped"),
    _counter("account/stored", "transitions_stored", "transitions", "stored by replay shards", "grows"),
    _gauge("account/dropped", "transitions_dropped", "transitions", "lost with a part, or that came twice", "0"),
    _counter("account/sampled", "transitions_sampled", "transitions", "drawn for updates", "updates x `batch_size`"),
)

HEALTH = (
    _gauge("system/cpu_utilization_percentage", "driver_cpu_percent", "%", "CPU of the driver's machine", "below 100"),
    _gauge(
        "system/system_memory_usage_percentage", "driver_memory_percent", "%", "memory of the driver's machine", "flat"
    ),
)

METRICS: tuple[Exported, ...] = (*THROUGHPUT, *LEARNING, *EVALUATION, *REPLAY, *TIMES, *ACCOUNTS, *HEALTH)
"""All of them, in the order of the operator's page."""
