"""Robot steps a second beside pyrvo and beside RVO2 in C++.

Both rivals are timed inside their step alone: what tells every robot where to head for is left out. Episodes last as
long as a robot needs to its goal without detour, so that they hold the way there, the crossing and the way out.
"""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyrvo
from rich.table import Table

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch, is_done
from tests.benchmarks.rvo2 import Rvo2Driver
from tests.benchmarks.timing import Timed, ratio, seconds_of_steps, spread, timed_rates

SETUPS = ((5, 2), (10, 4), (25, 4), (25, 8))
NUM_WORLDS = 64
EPISODE_STEPS = 240
ROUNDS = 5
FULL_ROBOT_STEPS = 1_000_000
PYRVO_ROBOT_STEPS = 250_000
ORCA_ROBOT_STEPS = 1_000_000
WARM_UP_STEPS = 300
FULL_TARGET = 4.0
ORCA_TARGETS = {10: 2.0, 40: 3.0, 100: 3.0, 200: 3.0}
SAME_VELOCITY_M_S = 1e-4


def fresh_worlds(config: WorldConfig) -> WorldBatch:
    worlds = WorldBatch(config, NUM_WORLDS)
    worlds.seed(list(range(NUM_WORLDS)))
    worlds.reset()
    return worlds


class RandomEpisodes:
    """Worlds under random actions that start again as they end: what a rollout worker asks of the simulator.

    They have run for a while, so that the worlds are at different points of their episodes.
    """

    def __init__(self, config: WorldConfig):
        self._worlds = fresh_worlds(config)
        self._actions = itertools.cycle(np.random.default_rng(0).integers(config.num_actions, size=(1024, NUM_WORLDS)))
        self.robot_steps = NUM_WORLDS * config.num_robots  # in one step
        for _ in range(WARM_UP_STEPS):
            self.step()

    def step(self) -> None:
        done = is_done(self._worlds.step(next(self._actions)).outcome)
        if done.any():
            self._worlds.reset(done)


def full_work(config: WorldConfig) -> Callable[[], Timed]:
    """FL-ORCA with perception, reward, outcomes and restarts."""
    episodes = RandomEpisodes(config)
    steps = max(100, FULL_ROBOT_STEPS // episodes.robot_steps)

    def work() -> Timed:
        start_s = time.perf_counter()
        for _ in range(steps):
            episodes.step()
        return Timed(steps * episodes.robot_steps, time.perf_counter() - start_s)

    return work


def pyrvo_simulator(config: WorldConfig) -> pyrvo.RVOSimulator:
    simulator = pyrvo.RVOSimulator(
        config.time_step_s,
        config.neighbour_range_m,
        config.max_neighbours,
        config.orca_horizon_s,
        config.orca_horizon_s,
        config.orca_radius_m,
        config.max_speed_m_s,
    )
    for _ in range(config.num_robots):
        simulator.add_agent((0.0, 0.0))
    return simulator


def head_for_goals(simulator: pyrvo.RVOSimulator, config: WorldConfig, goals: list[list[float]]) -> None:
    """Straight to the goal at full speed, slower within the last metre."""
    for i in range(config.num_robots):
        goal, position = goals[i // config.robots], simulator.get_agent_position(i)
        dx, dy = goal[0] - position.x, goal[1] - position.y
        scale = config.max_speed_m_s / max(1.0, math.hypot(dx, dy))
        simulator.set_agent_pref_velocity(i, (scale * dx, scale * dy))


def pyrvo_work(config: WorldConfig) -> Callable[[], Timed]:
    """ORCA alone in one world, from the same starts as ours one after another; only `do_step` is timed."""
    worlds = fresh_worlds(config)
    starts = itertools.cycle(zip(worlds.positions().tolist(), worlds.goals().tolist(), strict=True))
    simulator = pyrvo_simulator(config)
    episodes = max(1, PYRVO_ROBOT_STEPS // (config.num_robots * EPISODE_STEPS))

    def work() -> Timed:
        seconds = 0.0
        for positions, goals in itertools.islice(starts, episodes):
            for i, position in enumerate(positions):
                simulator.set_agent_position(i, tuple(position))
                simulator.set_agent_velocity(i, (0.0, 0.0))
            for _ in range(EPISODE_STEPS):
                head_for_goals(simulator, config, goals)
                start_s = time.perf_counter()
                simulator.do_step()
                seconds += time.perf_counter() - start_s
        return Timed(episodes * EPISODE_STEPS * config.num_robots, seconds)

    return work


def full_table() -> Table:
    table = Table(
        title=f"full FL-ORCA (perception, reward, outcomes, restarts; {NUM_WORLDS} worlds) against pyrvo's do_step\n"
        f"million robot steps/s, one core, median (lowest … highest) of {ROUNDS}"
    )
    for column in ("setup", "robots", "shoal", "ns/robot step", "env steps/s", "pyrvo", "ratio", "target"):
        table.add_column(column, justify="right")
    for robots, groups in SETUPS:
        config = WorldConfig(robots=robots, groups=groups)
        found = timed_rates({"own": full_work(config), "pyrvo": pyrvo_work(config)}, ROUNDS)
        own = spread(found["own"]).median
        table.add_row(
            config.setup,
            str(config.num_robots),
            millions(found["own"]),
            f"{1e9 / own:,.0f}",
            f"{own / config.num_robots:,.0f}",
            millions(found["pyrvo"]),
            ratio(found["own"], found["pyrvo"]).text(2),
            f"≥ {FULL_TARGET:g}",
        )
    return table


def orca_work(config: WorldConfig) -> Callable[[], Timed]:
    """ORCA alone, all worlds from their starts; setting them back is not timed."""
    worlds = fresh_worlds(config)
    start = worlds.get_state()
    episodes = orca_episodes(config)

    def work() -> Timed:
        seconds = sum(seconds_of_steps(worlds, start, EPISODE_STEPS) for _ in range(episodes))
        return Timed(episodes * EPISODE_STEPS * NUM_WORLDS * config.num_robots, seconds)

    return work


def rvo2_work(driver: Rvo2Driver, config: WorldConfig) -> Callable[[], Timed]:
    def work() -> Timed:
        run = driver.run(orca_episodes(config), EPISODE_STEPS)
        return Timed(run.robot_steps, run.seconds)

    return work


def orca_episodes(config: WorldConfig) -> int:
    return max(1, ORCA_ROBOT_STEPS // (EPISODE_STEPS * NUM_WORLDS * config.num_robots))


def same_share(driver: Rvo2Driver, config: WorldConfig) -> float:
    """Share of robots that get RVO2's velocity in a step from the middle of an episode."""
    worlds = fresh_worlds(config)
    for _ in range(EPISODE_STEPS // 2):
        worlds.swarm_step()
    position, velocity = worlds.positions(), velocities(worlds)
    heading = np.repeat(worlds.goals(), config.robots, axis=1) - position
    preferred = config.max_speed_m_s * heading / np.maximum(1, np.linalg.norm(heading, axis=-1, keepdims=True))
    worlds.swarm_step()
    theirs = np.stack([driver.velocities(*world) for world in zip(position, velocity, preferred, strict=True)])
    return float((np.abs(velocities(worlds) - theirs).max(axis=-1) < SAME_VELOCITY_M_S).mean())


def velocities(worlds: WorldBatch):
    state, robots = worlds.get_state(), worlds.config.num_robots
    return np.stack([state["vel_x"][:, :robots], state["vel_y"][:, :robots]], axis=-1)


def orca_table(rvo2: Sequence[Path]) -> Table | str:
    if not rvo2:
        return "orca: needs RVO2's C++ driver, --rvo2 PATH; tests/benchmarks/README.md tells how to build it\n"
    table = Table(
        title=f"ORCA alone against RVO2 in C++, {NUM_WORLDS} worlds\n"
        f"million robot steps/s, one core, median (lowest … highest) of {ROUNDS}",
        caption="ns: a robot step; near: neighbours a robot; same: robots whose velocity after a mid-episode step is\n"
        f"RVO2's within {SAME_VELOCITY_M_S:g} m/s",
    )
    columns = ("setup", "near", "shoal", "ns", "driver", "RVO2", "ns", "ratio", "target", "same")
    for column in columns:
        table.add_column(column, justify="right")
    for robots, groups in SETUPS:
        for row in orca_rows(WorldConfig(robots=robots, groups=groups, flocking="none"), rvo2):
            table.add_row(*row)
        table.add_section()
    return table


def orca_rows(config: WorldConfig, rvo2: Sequence[Path]) -> list[tuple[str, ...]]:
    """One row a driver; all take turns."""
    with ExitStack() as stack:
        drivers = [stack.enter_context(Rvo2Driver(path, fresh_worlds(config))) for path in rvo2]
        rivals = {str(path): rvo2_work(driver, config) for path, driver in zip(rvo2, drivers, strict=True)}
        found = timed_rates({"own": orca_work(config), **rivals}, ROUNDS)
        own = found["own"]
        return [
            (
                config.setup,
                f"{driver.run(1, EPISODE_STEPS).mean_neighbours:.1f}",
                millions(own),
                f"{1e9 / spread(own).median:,.0f}",
                path.name,
                millions(theirs),
                f"{1e9 / spread(theirs).median:,.0f}",
                ratio(own, theirs).text(2),
                f"≥ {ORCA_TARGETS[config.num_robots]:g}",
                f"{100 * same_share(driver, config):.1f} %",
            )
            for path, driver, theirs in zip(rvo2, drivers, (found[str(path)] for path in rvo2), strict=True)
        ]


def millions(per_second: list[float]) -> str:
    return spread([value / 1e6 for value in per_second]).text(2)
