"""Invariances of one step of ORCA: numbering, translation, rotation, reflection, units, robots out of range.

Numbering, units and robots out of range change no rounding, so float32 results must be equal bit for bit. A rotation
rounds every number anew, and ORCA amplifies rounding errors a million times and more where half-planes are almost
parallel. Scenes are therefore rotated in float64, where the errors stay small. Robots are left out if rounding decides
who their neighbours are (two equally near, or one at the edge of the range).
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.sim_core.kernels import orca_velocities
from tests.sim_core.orca_scenes import (
    GENERIC_KINDS,
    KINDS,
    Scene,
    coincides,
    distances_sq,
    numbered_scene,
    range_margin_sq,
    tie_margin_sq,
)

NUMBERS = st.integers(0, 10**9)
SIZES = st.integers(2, 80)
STRICT = settings(max_examples=100, deadline=None, derandomize=True)


def moved_scene(scene, angle, mirrored, shift_m):
    """(scene, matrix): the scene in float64, reflected at the x axis if `mirrored`, rotated and shifted."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.array([[cos, -sin], [sin, cos]]) @ np.diag([1.0, -1.0 if mirrored else 1.0])
    pos, vel, pref = (array.astype(np.float64) @ matrix.T for array in scene)
    return Scene(pos + shift_m, vel, pref), matrix


def clear_of_edges(scene, margin_sq=1e-9):
    """Mask of the robots whose neighbour lists do not change if squared distances change by `margin_sq`, m^2."""
    pos = scene.pos.astype(np.float64)
    return (tie_margin_sq(pos) > margin_sq) & (range_margin_sq(pos) > margin_sq)


@STRICT
@given(kind=st.sampled_from(KINDS), number=NUMBERS, n=SIZES, order_seed=NUMBERS)
def test_another_numbering_permutes_the_velocities(kind, number, n, order_seed):
    scene = numbered_scene(kind, number, n)
    order = np.random.default_rng(order_seed).permutation(n)
    clear = (tie_margin_sq(scene.pos) > 0) & ~coincides(scene.pos)
    new = orca_velocities(*scene)
    again = orca_velocities(*(array[order] for array in scene))
    np.testing.assert_array_equal(again[clear[order]], new[order][clear[order]])


@STRICT
@given(
    kind=st.sampled_from(GENERIC_KINDS),
    number=NUMBERS,
    n=SIZES,
    angle=st.floats(-np.pi, np.pi),
    mirrored=st.booleans(),
    shift_m=st.tuples(st.floats(-100, 100), st.floats(-100, 100)),
)
def test_a_rotated_reflected_and_shifted_scene_gives_the_same_velocities(kind, number, n, angle, mirrored, shift_m):
    scene = numbered_scene(kind, number, n)
    moved, matrix = moved_scene(scene, angle, mirrored, shift_m)
    new = orca_velocities(*scene, real=np.float64)
    error = np.abs(orca_velocities(*moved, real=np.float64) - new @ matrix.T)[clear_of_edges(scene)]
    assert error.max(initial=0) < 1e-5  # the largest of 85,000 robots is 4e-7


@pytest.mark.parametrize("kind", GENERIC_KINDS)
def test_a_rotation_changes_almost_nothing_for_almost_all_robots(kind):
    rng, errors = np.random.default_rng(0), []
    for number in range(60):
        scene = numbered_scene(kind, number)
        moved, matrix = moved_scene(scene, rng.uniform(-np.pi, np.pi), bool(number % 2), rng.uniform(-100, 100, 2))
        new = orca_velocities(*scene, real=np.float64)
        error = np.abs(orca_velocities(*moved, real=np.float64) - new @ matrix.T)
        errors.append(error[clear_of_edges(scene)].max(axis=1))
    errors = np.concatenate(errors)
    assert len(errors) > 2000
    assert np.median(errors) < 1e-13 and np.quantile(errors, 0.99) < 1e-9


@STRICT
@given(kind=st.sampled_from(KINDS), number=NUMBERS, n=SIZES, length=st.integers(-6, 6), time=st.integers(-4, 4))
def test_units_do_not_matter(kind, number, n, length, time):
    """Units of length and time are the metre and the second times powers of two."""
    metre, second = 2.0**length, 2.0**time
    pos, vel, pref = numbered_scene(kind, number, n)
    new = orca_velocities(pos, vel, pref)
    scaled = orca_velocities(
        pos * metre,
        vel * (metre / second),
        pref * (metre / second),
        radius_m=0.2 * metre,
        horizon_s=2.0 * second,
        time_step_s=0.05 * second,
        max_speed_m_s=metre / second,
        range_m=1.5 * metre,
    )
    np.testing.assert_array_equal(scaled, new * (metre / second))


@STRICT
@given(kind=st.sampled_from(KINDS), number=NUMBERS, n=SIZES, num_far=st.integers(1, 40))
def test_robots_out_of_range_change_nothing(kind, number, n, num_far):
    scene, far = numbered_scene(kind, number, n), numbered_scene("jammed", number, num_far)
    far = far._replace(pos=far.pos + np.float32(1e4))
    both = Scene(*(np.concatenate(arrays) for arrays in zip(scene, far, strict=True)))
    np.testing.assert_array_equal(orca_velocities(*both)[:n], orca_velocities(*scene))


@pytest.mark.parametrize("kind", KINDS)
def test_only_neighbours_and_not_their_preferences_matter(kind):
    """With its neighbours alone, and other preferred velocities of theirs, a robot moves as in the whole scene."""
    rng = np.random.default_rng(0)
    for number in range(30):
        scene = numbered_scene(kind, number, int(rng.integers(20, 60)))
        nearest, new = np.argsort(distances_sq(scene.pos), axis=1, kind="stable"), orca_velocities(*scene)
        for robot in range(len(new)):
            kept = np.sort([robot, *nearest[robot, :10]])  # sorted, as ties are ordered by index
            pref = np.where(kept[:, None] == robot, scene.pref[kept], rng.normal(0, 1, (len(kept), 2)))
            alone = orca_velocities(scene.pos[kept], scene.vel[kept], pref)
            np.testing.assert_array_equal(alone[kept == robot][0], new[robot])
