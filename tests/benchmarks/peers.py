"""`make bench-peers`: the same training by shoal and by what a user would take instead, side by side.

Each contest sets the environment, the network, the batch and the samples per insert. Every contender trains in a
process of its own, one at a time, in turn. Measured are rates (env steps and updates a second once training has begun)
and the time to a threshold: from the start of the training, environments and Ray being up, to the first evaluation that
reaches it; and the same from the start of the contender's process. The watch stands still while the judge plays, and so
does the training. Before each of the three, every contender tries several numbers of environments and threads, ours
with Ray and without, and keeps what serves it best there. "The limit" is no contender: what bare simulation and bare
updates would leave time for on this machine. The last table has all of it as ratios.
"""

import argparse
import dataclasses
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from learner.config import RunConfig
from learner.ray_backend.auth import guard_ray
from tests.benchmarks.contest import Finding
from tests.benchmarks.entrants import LIMIT, OURS, Contender, Contest, Entry, contenders, contests
from tests.benchmarks.timing import ratio, spread

AT_LEAST = "≥ "
PEERS = ("Stable-Baselines3", "TorchRL", "RLlib")
SWEEP_S = 6.0
TRIAL_SEEDS = (1_000, 1_001)
"""Trainings by which a contender chooses how to go about a threshold; none of them counts."""


def fastest(name: str, contender: Contender, contest: Contest, console: Console) -> Entry:
    """The contender in the style of the most env steps a second."""

    def rate(entry: Entry) -> float:
        found = entry.run(contest.config, SWEEP_S, None).env_steps_per_s
        console.print(f"  {name}, {entry.style.text()}: {found:,.0f} env steps/s")
        return found

    return max((Entry(name, contender, style) for style in contender.styles(contest)), key=rate)


class Soonest(NamedTuple):
    """A contender in the style of the least time to the threshold, and in that of the least time from its start."""

    trained: Entry
    started: Entry


def soonest(name: str, contender: Contender, contest: Contest, limit_s: float, console: Console) -> Soonest:
    """What serves a contender best, by trainings that do not count."""
    trials = [dataclasses.replace(contest.config, seed=seed) for seed in TRIAL_SEEDS]
    trained, started = {}, {}
    for style in contender.styles(contest):
        entry = Entry(name, contender, style)
        found = [entry.run(config, limit_s, contest.threshold) for config in trials]
        trained[entry] = statistics.fmean(seconds_of(found, limit_s))
        started[entry] = statistics.fmean(seconds_from_start(found, limit_s))
        texts = f"{trained[entry]:.1f} s to {contest.threshold:g}, {started[entry]:.1f} s with start-up"
        console.print(f"  {name}, {style.text()}: {texts}")
    return Soonest(min(trained, key=trained.__getitem__), min(started, key=started.__getitem__))


def rate_table(contest: Contest, found: dict[Entry, list[Finding]]) -> Table:
    table = Table(title=f"{contest.title}: rates, median (lowest … highest)")
    for column in ("contender", "its best", "env steps/s", "updates/s", "samples/insert", "shoal / it"):
        table.add_column(column, justify="left" if column in ("contender", "its best") else "right")
    steps = {entry.name: [finding.env_steps_per_s for finding in findings] for entry, findings in found.items()}
    for entry, findings in found.items():
        against = "" if entry.name == OURS else ratio(steps[OURS], steps[entry.name]).text(1)
        updates = spread([finding.updates_per_s for finding in findings])
        samples = spread([one.updates_per_s * contest.config.batch_size / one.env_steps_per_s for one in findings])
        row = (entry.style.text(), spread(steps[entry.name]).text(), updates.text(), f"{samples.median:.1f}", against)
        table.add_row(entry.name, *row)
    return table


def threshold_table(contest: Contest, found: dict[Entry, list[Finding]], limit_s: float) -> Table:
    table = Table(title=f"{contest.title}: seconds to {contest.threshold:g}, median (lowest … highest)")
    for column in ("contender", "its best", "reached", "seconds", "with start-up", "env steps"):
        table.add_column(column, justify="left" if column in ("contender", "its best") else "right")
    for entry, findings in found.items():
        reached = sum(finding.to_threshold_s is not None for finding in findings)
        least = "" if reached == len(findings) else AT_LEAST
        table.add_row(
            entry.name,
            entry.style.text(),
            f"{reached} of {len(findings)}",
            least + spread(seconds_of(findings, limit_s)).text(1),
            least + spread(seconds_from_start(findings, limit_s)).text(1),
            spread([finding.env_steps for finding in findings]).text(),
        )
    return table


def seconds_of(findings: list[Finding], limit_s: float) -> list[float]:
    """Times to the threshold, the limit where it was not reached."""
    return [limit_s if finding.to_threshold_s is None else finding.to_threshold_s for finding in findings]


def seconds_from_start(findings: list[Finding], limit_s: float) -> list[float]:
    """The same from the start of the contender's process."""
    return [wait + one.start_up_s for wait, one in zip(seconds_of(findings, limit_s), findings, strict=True)]


def rate_ratios(contest: Contest, found: dict[Entry, list[Finding]]) -> dict[str, str]:
    """A line of the last table: our env steps/s over those of each other."""
    steps = {entry.name: [finding.env_steps_per_s for finding in findings] for entry, findings in found.items()}
    others = {name: ratio(steps[OURS], theirs).text(2) for name, theirs in steps.items() if name != OURS}
    return {"": f"{contest.title}: env steps/s", **others}


def time_ratios(
    contest: Contest, players: list[Soonest], found: dict[Entry, list[Finding]], limit_s: float
) -> list[dict[str, str]]:
    """Lines of the last table: each other's time to the threshold over ours, where ours reached it in all rounds.

    The first line is the training's time alone, the second counts the start-up.
    """

    def line(
        title: str, entries: list[Entry], seconds: Callable[[list[Finding], float], list[float]]
    ) -> dict[str, str]:
        late = {entry.name for entry in entries if any(one.to_threshold_s is None for one in found[entry])}
        waits = {entry.name: seconds(found[entry], limit_s) for entry in entries}
        if OURS in late:
            return {"": f"{title}, which shoal did not always reach"}
        others = {
            name: (AT_LEAST if name in late else "") + ratio(theirs, waits[OURS]).text(2)
            for name, theirs in waits.items()
            if name != OURS
        }
        return {"": title, **others}

    title = f"{contest.title}: time to {contest.threshold:g}"
    return [
        line(title, [player.trained for player in players], seconds_of),
        line(f"{title}, with start-up", [player.started for player in players], seconds_from_start),
    ]


def last_table(lines: list[dict[str, str]]) -> Table:
    """All ratios that were found."""
    names = list(dict.fromkeys(name for line in lines for name in line))
    table = Table(title="shoal's rate, or the inverse of its time, over that of each: median (lowest … highest)")
    for name in names:
        table.add_column(name, justify="right" if name else "left")
    for line in lines:
        table.add_row(*(line.get(name, "") for name in names))
    return table


def hold(
    contest: Contest, field: dict[str, Contender], options: argparse.Namespace, console: Console
) -> list[dict[str, str]]:
    """Runs one contest and prints its tables; returns the lines of the last one."""
    console.print(contest.title)
    lines = []
    if not options.times_only:
        entries = [fastest(name, contender, contest, console) for name, contender in field.items()]
        found = in_turn(entries, [contest.config] * options.rounds, options.seconds, None)
        console.print(rate_table(contest, found))
        lines.append(rate_ratios(contest, found))
    if contest.threshold is not None:
        seeds = [dataclasses.replace(contest.config, seed=seed) for seed in range(options.rounds)]
        players = [
            soonest(name, contender, contest, options.limit_s, console)
            for name, contender in field.items()
            if name != LIMIT
        ]
        entries = list(dict.fromkeys(entry for player in players for entry in player))
        found = in_turn(entries, seeds, options.limit_s, contest.threshold)
        console.print(threshold_table(contest, found, options.limit_s))
        lines += time_ratios(contest, players, found, options.limit_s)
    return lines


def in_turn(
    entries: list[Entry], rounds: list[RunConfig], seconds: float, threshold: float | None
) -> dict[Entry, list[Finding]]:
    """What each contender found in every round, one after the other, so that the machine drifts for all alike."""
    found: dict[Entry, list[Finding]] = {entry: [] for entry in entries}
    for config in rounds:
        for entry in entries:
            found[entry].append(entry.run(config, seconds, threshold))
    return found


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    known = contests()
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.peers", description=__doc__)
    parser.add_argument("contests", nargs="*", help=f"of {', '.join(known)}; default: all")
    parser.add_argument("--rllib", type=Path, metavar="PYTHON", help="an interpreter with shoal and ray[rllib]")
    parser.add_argument("--only", nargs="+", choices=PEERS, help="the peers beside shoal; default: all")
    parser.add_argument("--rounds", type=int, default=3, help="of every measurement; of the threshold, seeds")
    parser.add_argument("--seconds", type=float, default=15.0, help="that a rate is measured for")
    parser.add_argument("--limit-s", type=float, default=600.0, help="after which a threshold counts as not reached")
    parser.add_argument("--times-only", action="store_true", help="measure times to a threshold, and no rates")
    options = parser.parse_args(arguments)
    for name in options.contests:
        if name not in known:
            parser.error(f"no contest {name!r}; there are: {', '.join(known)}")
    if options.rllib is not None and not options.rllib.is_file():
        parser.error(f"--rllib: there is no file {options.rllib}")
    return options


def main() -> int:
    options = parse()
    guard_ray(joins=False)  # for the contenders, which inherit the environment
    console = Console(width=160)
    field = contenders(options.rllib, console)
    if options.only:
        field = {name: contender for name, contender in field.items() if name in (OURS, LIMIT, *options.only)}
    held = [contest for name, contest in contests().items() if not options.contests or name in options.contests]
    console.print(last_table([line for contest in held for line in hold(contest, field, options, console)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
