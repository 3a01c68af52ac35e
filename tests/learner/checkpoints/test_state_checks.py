"""Types and config of a checkpoint's state are checked before it is used."""

import dataclasses
import json
from pathlib import Path

import pytest

from learner.checkpoints.checkpoint import STATE_TYPES, Checkpoint, check_config, check_state
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.config import to_dict

CONFIG_FILE = Path("runs/r/config.json")


@pytest.fixture
def checkpoint(small_run):
    state = {name: empty() for name, empty in STATE_TYPES.items()} | {"config": to_dict(small_run)}
    return Checkpoint(Path("step-1"), json.loads(json.dumps(state)))


def test_a_state_of_the_right_types_passes(checkpoint, small_run):
    check_state(checkpoint)
    check_config(checkpoint, small_run, CONFIG_FILE)


@pytest.mark.parametrize("name", STATE_TYPES)
@pytest.mark.parametrize("value", [None, "x", -1, True, 1.5, [[]], {"a": []}])
def test_another_type_is_refused(checkpoint, name, value):
    checkpoint.state[name] = value
    if type(value) is not STATE_TYPES[name] or value == -1:
        with pytest.raises(UnusableCheckpointError, match=name):
            check_state(checkpoint)
    del checkpoint.state[name]
    with pytest.raises(UnusableCheckpointError, match=name):
        check_state(checkpoint)


def test_length_and_placement_may_change(checkpoint, small_run):
    check_config(checkpoint, dataclasses.replace(small_run, total_env_steps=9_999, engine="ray"), CONFIG_FILE)


def test_another_setting_is_named(checkpoint, small_run):
    other = dataclasses.replace(small_run, learning_rate=0.5)
    with pytest.raises(CheckpointError, match=r"config.json, where learning_rate is 0.5 instead of 0.001") as caught:
        check_config(checkpoint, other, CONFIG_FILE)
    assert type(caught.value) is CheckpointError
    other = dataclasses.replace(small_run, world=dataclasses.replace(small_run.world, robots=4))
    with pytest.raises(CheckpointError, match="robots is 4 instead of 3"):
        check_config(checkpoint, other, CONFIG_FILE)


def test_a_setting_newer_than_the_checkpoint_has_its_default_there(checkpoint, small_run):
    del checkpoint.state["config"]["gradients"]
    check_config(checkpoint, small_run, CONFIG_FILE)
    with pytest.raises(CheckpointError, match="gradients is autograd instead of by_hand"):
        check_config(checkpoint, dataclasses.replace(small_run, gradients="autograd"), CONFIG_FILE)


@pytest.mark.parametrize("changes", [{"from_the_future": 1}, {"batch_size": "many"}, {"world": 3}])
def test_a_config_from_another_version_is_refused(checkpoint, small_run, changes):
    checkpoint.state["config"] |= changes
    with pytest.raises(CheckpointError, match="another version of shoal"):
        check_config(checkpoint, small_run, CONFIG_FILE)
