"""Figure 3.2 by a learned policy, and films of two of its episodes: one that arrives and one that is captured.

python -m tests.dashboards.learned_episodes dashboards/images

The policy is M_sensor's, trained with the preset `thesis` in 10r×8g, since the figure has eight groups. A run that is
there is used.
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

from dashboards.figures.example_episodes import FRAMES, find_episode
from dashboards.figures.film_strip import episode_strip
from dashboards.figures.style import save_png
from dashboards.figures.video import episode_frames, write_mp4
from deploy.runs.policy_lookup import find_policy
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from tests.benchmarks.trainings import trained

NAME = "figure-3-2"
SIZE_PX = 300
STEPS_PER_FRAME = 4
FASTER = 2
"""How much faster than simulated time the films play."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the figure and the films")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs"))
    arguments = parser.parse_args()
    setup = ["--preset", "thesis", "--robots", "10", "--groups", "8", "--engine", "process"]
    run = trained(arguments.runs_dir, NAME, setup)
    config = run.config()
    world, weights = config.world, find_policy(run, config)
    for outcome in (Outcome.GOAL, Outcome.CAPTURED):
        episode = find_episode(config.env, weights, outcome, config.final_eval_first_seed)
        if episode is None:
            raise SystemExit(f"no episode ends in {OUTCOME_NAMES[outcome]}")
        film = arguments.out / f"learned-{OUTCOME_NAMES[outcome]}.mp4"
        frames = islice(episode_frames(episode, world, SIZE_PX), 0, None, STEPS_PER_FRAME)
        write_mp4(frames, film, FASTER / (world.time_step_s * STEPS_PER_FRAME))
        print(f"{film}: seed {episode.seed}, {len(episode.action) - 1} env steps")
        if outcome is Outcome.GOAL:
            figure = episode_strip(episode, world, FRAMES, "Played by a learned policy.")
            save_png(figure, arguments.out / f"{NAME}-learned.png")


if __name__ == "__main__":
    main()
