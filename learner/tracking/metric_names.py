"""The table of all metrics that Prometheus gets: their names, units and meanings, for code, dashboards and docs.

Metrics are measured once, in the journal's rows; `learner.ray_backend.metrics` exports the rows under these names. Ray
adds the prefix `ray_`, and the suffix `_total` to counters.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

ENV_STEPS = "env_steps"
"""In place of a journal name: the row's own count of env steps."""


class MetricSpec(NamedTuple):
    """One metric: its names in the journal and in Ray, its kind, and its row in learner/README.md."""

    journal: str
    name: str
    kind: Literal["gauge", "counter"]
    unit: str
    meaning: str
    healthy: str

    @property
    def series(self) -> str:
        """Its name in Prometheus queries."""
        return f"ray_{self.name}_total" if self.kind == "counter" else f"ray_{self.name}"


def _gauge(journal: str, name: str, unit: str, meaning: str, healthy: str) -> MetricSpec:
    return MetricSpec(journal, f"shoal_{name}", "gauge", unit, meaning, healthy)


def _counter(journal: str, name: str, unit: str, meaning: str, healthy: str) -> MetricSpec:
    return MetricSpec(journal, f"shoal_{name}", "counter", unit, meaning, healthy)


THROUGHPUT = (
    _counter(ENV_STEPS, "env_steps", "env steps", "of the run so far, before and after resumes", "grows"),
    _counter("account/updates", "updates", "updates", "of the run so far, before and after resumes", "grows"),
    _counter("account/episodes", "episodes", "episodes", "training episodes that have ended", "grows"),
    _gauge("speed/env_steps_per_s", "env_steps_per_second", "env steps/s", "mean since the last row", "steady"),
    _gauge("speed/updates_per_s", "updates_per_second", "updates/s", "mean since the last row", "steady"),
)

LEARNING = (
    _gauge("train/epsilon", "epsilon", "share", "exploration rate of the newest block", "falls to `epsilon_end`"),
    _gauge(
        "train/success_rate",
        "train_success_rate",
        "share",
        "training episodes since the last row that reached the goal",
        "rises; below the evaluated rate while epsilon is large",
    ),
    _gauge("train/return", "train_return", "reward", "mean return of training episodes since the last row", "rises"),
    _gauge(
        "train/episode_length",
        "train_episode_length",
        "steps",
        "mean length of training episodes since the last row",
        "below the horizon",
    ),
    _gauge("train/loss", "loss", "squared reward", "mean loss of the updates", "small, not growing"),
    _gauge("train/td_error", "td_error", "reward", "mean absolute TD error", "small, not growing"),
    _gauge("train/q_mean", "q_mean", "reward", "mean action value in the batches", "bounded by the best return"),
)


def _evaluated() -> tuple[MetricSpec, ...]:
    ends = {"low": "lower end of its 95 % interval", "high": "upper end of its 95 % interval"}
    rates = {
        "success": ("greedy episodes on fixed seeds that reached the goal", "rises"),
        "lost": ("greedy episodes in which the robot was lost", "falls"),
        "captured": ("greedy episodes in which the robot was captured", "falls"),
        "collision": ("greedy episodes that ended in a collision", "falls"),
        "timeout": ("greedy episodes that ended at the horizon", "falls"),
        "all_arrive": ("worlds in which every learning robot reached its goal, where several learn", "rises"),
        "learner_collision": ("episodes that ended in a collision of two learning robots, likewise", "falls"),
    }
    rows = []
    for name, (meaning, healthy) in rates.items():
        rows.append(_gauge(f"eval/{name}_rate", f"eval_{name}_rate", "share", meaning, healthy))
        rows += [
            _gauge(f"eval/{name}_rate_{end}", f"eval_{name}_rate_{end}", "share", text, "")
            for end, text in ends.items()
        ]
    rows.append(_gauge("eval/return", "eval_return", "reward", "mean return of the greedy episodes", "rises"))
    rows += [
        _gauge(f"eval/return_{end}", f"eval_return_{end}", "reward", f"{text}, in environments without outcomes", "")
        for end, text in ends.items()
    ]
    meaning = "mean length of the greedy episodes"
    length = _gauge("eval/episode_length", "eval_episode_length", "steps", meaning, "below the horizon")
    meaning = "mean time of the last arrival in worlds where all arrive, where several robots learn"
    last = _gauge("eval/last_arrival_steps", "eval_last_arrival_steps", "steps", meaning, "falls")
    meaning = "pairs of groups that were segregated along the way (Eq. 3.1), where several robots learn"
    segregation = _gauge("eval/segregation", "eval_segregation", "share", meaning, "near 1")
    return (*rows, length, last, segregation, *_values())


def _values() -> tuple[MetricSpec, ...]:
    of_start, of_all = "the first states of greedy episodes", "all states of greedy episodes"
    followed, near = "mean discounted return that followed", "near what follows"
    return (
        _gauge("eval/q_start", "eval_q_start", "reward", f"mean value of the actions in {of_start}", near),
        _gauge("eval/return_start", "eval_return_start", "reward", f"{followed} {of_start}", "rises"),
        _gauge("eval/q_visited", "eval_q_visited", "reward", f"mean value of the actions in {of_all}", near),
        _gauge("eval/return_visited", "eval_return_visited", "reward", f"{followed} {of_all}", "rises"),
    )


EVALUATION = _evaluated()

REPLAY = (
    _gauge("replay/size", "replay_size", "transitions", "stored in all shards together", "grows to `replay_capacity`"),
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
        "the same age in seconds, by the clocks of two nodes",
        "a few seconds",
    ),
    _counter(
        "account/waits_to_insert",
        "waits_to_insert",
        "rounds",
        "of the loop in which a rollout worker had to wait for the learner",
        "grows if the learner is the slower side",
    ),
    _counter(
        "account/waits_to_sample",
        "waits_to_sample",
        "rounds",
        "of the loop in which the learner had to wait for transitions",
        "grows if the rollout workers are the slower side",
    ),
)


def _share(component: str, activity: str, meaning: str, healthy: str) -> MetricSpec:
    name = f"{component.split()[-1]}_{activity}"
    return _gauge(f"time/{name}", f"time_{name}", "share", f"of the {component}'s time: {meaning}", healthy)


_LIMITS = "high if it limits the run"
_WAITS = "waiting for the training loop, and for checkpoints"
TIMES = (
    _share("rollout worker", "acts", "stepping environments", _LIMITS),
    _share("rollout worker", "stores", "waiting for a shard's reply to a push", "small"),
    _share(
        "rollout worker",
        "waits",
        _WAITS,
        "high if the learner limits the run",
    ),
    _share("learner", "updates", "making updates", _LIMITS),
    _share("learner", "samples", "sampling transitions, or waiting for shards", "small"),
    _share("learner", "publishes", "publishing weights and TD errors", "small"),
    _share("learner", "stores", "storing the rollout workers' blocks, where it holds the shards", "small"),
    _share(
        "learner",
        "waits",
        _WAITS,
        "high if the rollout workers limit the run",
    ),
)

# Ray exports a counter only once it is above 0. What should stay 0 is therefore a gauge.
ACCOUNTS = (
    _counter("account/produced", "transitions_produced", "transitions", "made by rollout workers", "stored + dropped"),
    _counter("account/stored", "transitions_stored", "transitions", "stored by replay shards", "grows"),
    _gauge("account/dropped", "transitions_dropped", "transitions", "lost with a component, or received twice", "0"),
    _counter("account/sampled", "transitions_sampled", "transitions", "sampled for updates", "updates x `batch_size`"),
)

HEALTH = (
    _gauge("system/cpu_utilization_percentage", "driver_cpu_percent", "%", "CPU of the driver's machine", "below 100"),
    _gauge(
        "system/system_memory_usage_percentage", "driver_memory_percent", "%", "memory of the driver's machine", "flat"
    ),
)

METRICS: tuple[MetricSpec, ...] = (*THROUGHPUT, *LEARNING, *EVALUATION, *REPLAY, *TIMES, *ACCOUNTS, *HEALTH)
"""All metrics, in the order of the table in learner/README.md."""
