"""Robot steps a second: full FL-ORCA with perception, reward and outcomes, beside pyrvo's ORCA alone."""

import numpy as np
import pyrvo
from rich.console import Console
from rich.table import Table

from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch, is_done
from tests.benchmarks.timing import rates, ratio, spread

SETUPS = ((5, 1), (10, 2), (10, 4), (25, 8))
NUM_WORLDS = 64
ROBOT_STEPS = 400_000
EPISODE_STEPS = 240
ROUNDS = 5


def own_work(config: WorldConfig):
    worlds = WorldBatch(config, NUM_WORLDS)
    worlds.seed(list(range(NUM_WORLDS)))
    worlds.reset()
    steps = max(1, ROBOT_STEPS // (NUM_WORLDS * config.num_robots))
    actions = np.random.default_rng(0).integers(config.num_actions, size=(steps, NUM_WORLDS))

    def work() -> int:
        for action in actions:
            done = is_done(worlds.step(action).outcome)
            if done.any():
                worlds.reset(done)
        return steps * NUM_WORLDS * config.num_robots

    return work


def reference_work(config: WorldConfig):
    """pyrvo from the same start scene, every robot heading for its goal; little but `do_step` is called.

    The scene starts again once the robots could be across, or it would soon be empty and cheap.
    """
    worlds = WorldBatch(config, 1)
    worlds.seed([0])
    worlds.reset()
    position, goal = worlds.positions()[0], worlds.goals()[0]
    simulator = pyrvo.RVOSimulator(
        config.time_step_s,
        config.neighbour_range_m,
        config.max_neighbours,
        config.orca_horizon_s,
        config.orca_horizon_s,
        config.orca_radius_m,
        config.max_speed_m_s,
    )
    for i, point in enumerate(position):
        simulator.add_agent(tuple(map(float, point)))
        heading = goal[i // config.robots] - point
        heading = heading / np.linalg.norm(heading)
        simulator.set_agent_pref_velocity(i, tuple(map(float, heading)))
    episodes = max(1, ROBOT_STEPS // (config.num_robots * EPISODE_STEPS))

    def work() -> int:
        for _ in range(episodes):
            for i, point in enumerate(position):
                simulator.set_agent_position(i, tuple(map(float, point)))
                simulator.set_agent_velocity(i, (0.0, 0.0))
            for _ in range(EPISODE_STEPS):
                simulator.do_step()
        return episodes * EPISODE_STEPS * config.num_robots

    return work


def main() -> None:
    table = Table(title=f"thousand robot steps/s, one core, {NUM_WORLDS} worlds, median (lowest … highest) of {ROUNDS}")
    for column in ("setup", "shoal, full FL-ORCA", "pyrvo do_step, ORCA only", "ratio", "shoal env steps/s"):
        table.add_column(column, justify="right")
    for robots, groups in SETUPS:
        config = WorldConfig(robots=robots, groups=groups)
        found = rates({"own": own_work(config), "pyrvo": reference_work(config)}, ROUNDS)
        own, reference = ([value / 1e3 for value in found[name]] for name in ("own", "pyrvo"))
        table.add_row(
            config.setup,
            spread(own).text(),
            spread(reference).text(),
            ratio(own, reference).text(2),
            f"{1e3 * spread(own).median / config.num_robots:,.0f}",
        )
    Console(width=140).print(table)
