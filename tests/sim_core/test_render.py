"""The rasteriser against the expected image: colours at known points, centroids, orientation of the view."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.render import GROUP_COLOURS, colour_rgb, draw_world, group_rgb, to_pixels, view_half_m

CONFIG = WorldConfig(robots=3, groups=2)
GOAL = np.array([[4.0, 0.0], [-4.0, 0.0]], np.float32)
POSITION = np.array([[-2.0, 3.0], [0.0, 3.0], [2.0, 3.0], [-2.0, -3.0], [0.0, -3.0], [2.0, -3.0]], np.float32)
LEARNER = 4


def pixel(image: np.ndarray, point_m: tuple[float, float], config: WorldConfig = CONFIG) -> list[int]:
    column, row = to_pixels(point_m, config, image.shape[0]).astype(int)
    return image[row, column].tolist()


def centroid(image: np.ndarray, near_m: tuple[float, float], half_px: int = 12) -> np.ndarray:
    """Centroid (column, row) of the pixels around a point that are not white."""
    column, row = to_pixels(near_m, CONFIG, image.shape[0]).astype(int)
    window = image[row - half_px : row + half_px + 1, column - half_px : column + half_px + 1]
    ink = (255.0 - window).sum(axis=-1)
    offsets = np.arange(-half_px, half_px + 1) + 0.5
    return np.array([column + (ink.sum(0) @ offsets) / ink.sum(), row + (ink.sum(1) @ offsets) / ink.sum()])


def test_image_is_square_rgb():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG, size_px=321)
    assert image.shape == (321, 321, 3)
    assert image.dtype == np.uint8


def test_robots_have_their_groups_colour_and_the_learning_robot_is_black():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG)
    for robot, point in enumerate(POSITION):
        expected = [0, 0, 0] if robot == LEARNER else colour_rgb(GROUP_COLOURS[robot // 3]).tolist()
        assert pixel(image, tuple(point)) == expected, robot


def test_learning_robot_has_a_ring_in_its_groups_colour():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG, size_px=960)
    column, row = to_pixels(POSITION[LEARNER], CONFIG, 960).astype(int)
    ring = image[row, column - 14 : column + 15]
    assert (ring == colour_rgb(GROUP_COLOURS[1])).all(axis=-1).sum() >= 2
    assert not (ring == colour_rgb(GROUP_COLOURS[0])).all(axis=-1).any()


def test_view_has_x_to_the_right_and_y_up():
    left_low = draw_world(np.full((6, 2), -3.0), GOAL, LEARNER, CONFIG)
    assert pixel(left_low, (-3.0, -3.0)) == [0, 0, 0]
    rows, columns = np.nonzero((left_low == 0).all(axis=-1) & (np.indices((480, 480))[0] > 300))
    assert rows.min() > 240
    assert columns.max() < 240


def test_discs_are_centred_with_subpixel_accuracy():
    """Edges are antialiased: a shift by a fraction of a pixel shifts the centroid as much."""
    px_m = 2 * view_half_m(CONFIG) / 480
    for shift_px in (0.0, 0.25, 0.5, 0.8):
        position = POSITION.astype(np.float64) + (shift_px * px_m, 0.0)
        image = draw_world(position, GOAL, LEARNER, CONFIG)
        found = centroid(image, (-2.0, 3.0))
        np.testing.assert_allclose(found, to_pixels(position[0], CONFIG, 480), atol=0.06)


def test_discs_have_the_true_radius():
    config = WorldConfig(robots=2, groups=1, robot_radius_m=0.2, start_spacing_m=0.6)
    goal = np.array([[0.0, -5.0]])
    image = draw_world(np.array([[-2.0, 2.0], [2.0, 2.0]]), goal, 1, config, size_px=960)
    column, row = to_pixels((-2.0, 2.0), config, 960).astype(int)
    width = (image[row, column - 40 : column + 40] != 255).any(axis=-1).sum()
    true_width = 0.4 * 960 / (2 * view_half_m(config))
    assert true_width <= width <= true_width + 3.5


def test_small_robots_stay_visible():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG, size_px=120)
    assert pixel(image, (-2.0, 3.0)) == colour_rgb(GROUP_COLOURS[0]).tolist()


def test_goals_are_hollow_squares_and_the_learning_robots_goal_has_a_black_outline():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG)
    for group, (x, y) in enumerate(GOAL):
        assert pixel(image, (x, y)) == [255, 255, 255]
        assert pixel(image, (x - 0.3, y)) == colour_rgb(GROUP_COLOURS[group]).tolist()
        column, row = to_pixels((x, y), CONFIG, 480).astype(int)
        edge = image[row, column - 16 : column]
        assert (edge == 0).all(axis=-1).any() == (group == 1)


def test_sensing_disc_is_shaded_up_to_its_radius():
    image = draw_world(POSITION, GOAL, LEARNER, CONFIG)
    inside, outside = pixel(image, (0.0, -3.0 + 1.4)), pixel(image, (0.0, -3.0 + 1.62))
    assert outside == [255, 255, 255]
    assert 200 < min(inside) and max(inside) < 250


def test_robots_outside_the_view_are_clipped():
    far = POSITION.copy()
    far[:3] = 1e6
    far[LEARNER] = [view_half_m(CONFIG), 0.0]
    image = draw_world(far, GOAL, LEARNER, CONFIG)
    assert not (image == colour_rgb(GROUP_COLOURS[0])).all(axis=-1)[:100].any()
    draw_world(np.full((6, 2), -1e5), GOAL, LEARNER, CONFIG)


def test_order_of_a_groups_robots_does_not_matter():
    rng = np.random.default_rng(0)
    position = np.concatenate([rng.normal(0, 0.1, (20, 2)), [[4.0, 4.0]]])
    config = WorldConfig(robots=21, groups=1)
    shuffled = np.concatenate([rng.permutation(position[:20]), position[20:]])
    one, other = (draw_world(p, GOAL[:1], 20, config).astype(int) for p in (position, shuffled))
    assert np.abs(one - other).max() <= 1


def test_images_do_not_depend_on_earlier_ones():
    first = draw_world(POSITION, GOAL, LEARNER, CONFIG)
    draw_world(POSITION + 0.5, GOAL, 0, CONFIG)
    np.testing.assert_array_equal(draw_world(POSITION, GOAL, LEARNER, CONFIG), first)


@pytest.mark.parametrize("robots, groups", [(2, 1), (25, 8)])
def test_every_start_and_goal_is_inside_the_view(robots: int, groups: int):
    from sim_core.worlds import WorldBatch

    config = WorldConfig(robots=robots, groups=groups)
    worlds = WorldBatch(config, 50)
    worlds.seed(list(range(50)))
    worlds.reset()
    for points in (worlds.positions(), worlds.goals()):
        px = to_pixels(points, config, 480)
        assert px.min() > 3
        assert px.max() < 477


def test_eight_groups_have_eight_colours():
    assert len({tuple(colour) for colour in group_rgb(8).tolist()}) == 8
    assert group_rgb(len(GROUP_COLOURS) + 1)[-1].tolist() == group_rgb(1)[0].tolist()


def test_needs_numpy_alone():
    code = "import sys, sim_core.render; print(*{'matplotlib', 'pygame', 'PIL', 'imageio'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == ""
