"""Eq. 3.1 and 3.2 against naive loops."""

import numpy as np
import pytest

from tests.sim_core.segregation import mean_goal_distance_m, mean_pairwise_distances_m, segregated_fraction


def naive_mean_distance(first, second):
    """Eq. 3.1, literally."""
    return sum(sum(np.hypot(*(p - q)) for q in second) / len(second) for p in first) / len(first)


@pytest.mark.parametrize("groups", [1, 2, 3, 5])
def test_equations_match_naive_loops(groups):
    rng = np.random.default_rng(groups)
    pos, goal = rng.normal(0, 3, (4, groups * 6, 2)), rng.normal(0, 3, (4, groups, 2))
    mean, to_goal = mean_pairwise_distances_m(pos, groups), mean_goal_distance_m(pos, goal)
    fraction = segregated_fraction(pos, groups)
    assert mean.shape == (4, groups, groups) and to_goal.shape == (4, groups) and fraction.shape == (4,)
    for world in range(4):
        blocks = [pos[world, g * 6 : (g + 1) * 6] for g in range(groups)]
        naive = np.array([[naive_mean_distance(x, y) for y in blocks] for x in blocks])
        np.testing.assert_allclose(mean[world], naive)
        expected = [sum(np.hypot(*(p - goal[world, g])) for p in blocks[g]) / 6 for g in range(groups)]
        np.testing.assert_allclose(to_goal[world], expected)
        pairs = [(x, y) for x in range(groups) for y in range(x)]
        apart = [naive[x, x] < naive[x, y] and naive[y, y] < naive[x, y] for x, y in pairs]
        assert fraction[world] == pytest.approx(np.mean(apart) if pairs else 1.0)


def test_a_single_scene_needs_no_batch_axis():
    pos = np.array([[0.0, 0.0], [0.0, 1.0], [5.0, 0.0], [5.0, 1.0]])
    assert segregated_fraction(pos, 2) == 1.0
    np.testing.assert_allclose(mean_pairwise_distances_m(pos, 2)[0, 0], 0.5)  # zero distances to oneself count


def test_equation_3_1_counts_mixed_groups_of_equal_spread_as_segregated():
    # With i = j counted, 2 d_XY - d_XX - d_YY is the energy distance (Szekely & Rizzo) and never negative. So d_XX
    # or d_YY is at most d_XY, and groups of equal spread count as segregated at any positions.
    rng = np.random.default_rng(0)
    for _ in range(200):
        mean = mean_pairwise_distances_m(rng.normal(0, 1, (20, 2)) * rng.uniform(0.5, 2, (20, 1)), 2)
        assert mean[0, 0] + mean[1, 1] <= 2 * mean[0, 1] + 1e-12
    angle = np.arange(40) * (2 * np.pi / 40)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert segregated_fraction(np.concatenate([circle[::2], circle[1::2]]), 2) == 1.0


def test_without_self_distances_mixed_groups_are_not_segregated():
    rng = np.random.default_rng(0)
    pos = rng.normal(0, 1, (300, 12, 2))
    mean = mean_pairwise_distances_m(pos, 2, count_self=False)
    for world in range(20):
        for group, block in enumerate((pos[world, :6], pos[world, 6:])):
            others = [np.hypot(*(block[i] - block[j])) for i in range(6) for j in range(6) if i != j]
            assert mean[world, group, group] == pytest.approx(np.mean(others))
    np.testing.assert_array_equal(mean[:, 0, 1], mean_pairwise_distances_m(pos, 2)[:, 0, 1])
    assert segregated_fraction(pos, 2, count_self=False).mean() < 0.5 * segregated_fraction(pos, 2).mean()
    assert (segregated_fraction(pos + 9 * (np.arange(12) < 6)[:, None], 2, count_self=False) == 1).all()
    assert np.isnan(mean_pairwise_distances_m(pos[:, :2], 2, count_self=False)[:, 0, 0]).all()


def test_self_distances_make_small_mixed_groups_count_as_segregated():
    # Eq. 3.1 as printed counts i = j: two fully mixed groups of two robots still count as segregated.
    square = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    assert mean_pairwise_distances_m(square, 2)[0, 0] == pytest.approx(np.sqrt(2) / 2)
    assert segregated_fraction(square, 2) == 1.0


def test_a_wide_group_around_a_tight_one_fails_on_one_side_only():
    # d_XX < d_XY holds for the tight group only, so both conditions are needed.
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    tight, wide = 0.01 * np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([np.cos(angle), np.sin(angle)], 1)
    pos = np.concatenate([tight, 5 * wide])
    mean = mean_pairwise_distances_m(pos, 2)
    assert mean[0, 0] < mean[0, 1] < mean[1, 1]
    assert segregated_fraction(pos, 2) == 0.0 and segregated_fraction(pos[::-1], 2) == 0.0


def test_groups_are_contiguous_blocks_of_robots():
    pos = np.array([[0.0, 0.0], [0.1, 0.0], [9.0, 0.0], [9.1, 0.0]])
    assert mean_pairwise_distances_m(pos, 2)[0, 0] == pytest.approx(0.05)
    assert mean_pairwise_distances_m(pos[[0, 2, 1, 3]], 2)[0, 0] == pytest.approx(4.5)


def test_the_fraction_of_three_groups_counts_pairs():
    line = np.stack([np.linspace(0, 1, 6), np.zeros(6)], axis=1)
    side = 3 * line + [[-1, 0.01]]  # its spread exceeds its distance to the first group
    pos = np.concatenate([line, side, line + 9])
    assert segregated_fraction(pos, 3) == pytest.approx(2 / 3)
