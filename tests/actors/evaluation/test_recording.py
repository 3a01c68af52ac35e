"""Recordings of episodes that velocities given from outside drive."""

import dataclasses

import numpy as np
import pytest

from actors.evaluation.recording import Recording
from actors.evaluation.trajectory import BY_HAND, load_episodes, save_episodes
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import Command, WorldBatch

WORLD = WorldConfig(robots=4, groups=2, arena_radius_m=2.0, horizon_steps=40)


def command(x, y):
    return Command(np.array([[x], [y]], np.float32))


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_the_learning_robot_moves_as_it_is_told(method):
    world = dataclasses.replace(WORLD, method=method)
    recording = Recording(world, 3)
    moves = [(0.5, 0.0), (0.0, -0.25), (0.0, 0.0), (-0.3, 0.4)]
    for x, y in moves:
        assert recording.step(command(x, y)) == Outcome.RUNNING
    episode = recording.episode()
    path = episode.position[:, episode.learner]
    np.testing.assert_allclose(np.diff(path, axis=0), world.time_step_s * np.array(moves), atol=1e-6)
    np.testing.assert_allclose(episode.velocity[1:, episode.learner], moves, atol=1e-6)
    assert episode.action.tolist() == [BY_HAND] * 4 + [-1]
    others = np.delete(episode.velocity[1:], episode.learner, axis=1)
    assert (np.linalg.norm(others, axis=-1) > 0).all()


def test_the_velocity_of_an_action_given_as_a_command_makes_the_same_episode():
    taken, told = WorldBatch(WORLD, 3), WorldBatch(WORLD, 3)
    taken.reset(), told.reset()
    angle = np.pi / WORLD.sectors + np.array([0, 3, 5]) * 2 * np.pi / WORLD.sectors - np.pi
    velocity = np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)
    for _ in range(20):
        first, second = taken.step(np.array([0, 3, 5])), told.step(Command(velocity))
        np.testing.assert_array_equal(first.outcome, second.outcome)
        np.testing.assert_allclose(taken.positions(), told.positions(), atol=1e-5)


def test_shield_and_faults_change_what_is_asked_for():
    world = dataclasses.replace(WORLD, shield="orca", command_delay_steps=2)
    recording = Recording(world, 3)
    for _ in range(6):
        recording.step(command(1.0, 0.0))
    episode = recording.episode()
    speed = np.linalg.norm(episode.velocity[1:, episode.learner], axis=-1)
    assert (speed[:2] == 0).all() and (speed[2:] > 0).all()
    np.testing.assert_array_equal(episode.asked[:-1], np.tile(np.float32([1, 0]), (6, 1)))


def test_a_part_of_it_is_the_end_of_the_whole():
    recording = Recording(dataclasses.replace(WORLD, position_loss=0.5), 4)
    for _ in range(5):
        recording.step(Pilot.FREE)
    whole, part = recording.episode(), recording.episode(3)
    for name in ("position", "velocity", "machine", "action", "reward", "sensed"):
        np.testing.assert_array_equal(getattr(whole, name)[3:], getattr(part, name))
    assert recording.steps == 5 and len(part.position) == 3


def test_what_a_person_drove_is_stored_and_read(tmp_path):
    recording = Recording(WORLD, 5)
    while recording.outcome == Outcome.RUNNING:
        recording.step(command(0.0, 0.0))
    save_episodes(tmp_path / "e.zarr", [recording.episode()], WORLD)
    (read,), world = load_episodes(tmp_path / "e.zarr")
    assert world == WORLD and (read.action[:-1] == BY_HAND).all()


def test_a_wrong_number_of_velocities_is_refused():
    with pytest.raises(ValueError, match=r"velocities must be \(2, 3\), not \(2, 1\)"):
        WorldBatch(WORLD, 3).step(command(1, 0))
