"""What a sweep's `settings.json` tells of how its results came about."""

import json

from deploy.sweep import SweepResults
from learner.sweep import SweepConfig


def test_the_example_of_a_method_is_a_cell_that_trains(tmp_path):
    grid = SweepConfig(methods=("sensor", "out"), robots=(5, 10), groups=(1,), seeds=(1,), baselines=("greedy",))
    SweepResults(grid, tmp_path, []).write()
    examples = json.loads((tmp_path / "settings.json").read_text())["a_cell_of_each_method"]
    assert set(examples) == {"sensor", "out"}
    for example in examples.values():
        assert example["final_eval_episodes"] == grid.episodes != grid.baseline_episodes
        assert example["world"]["robots"] == 5
