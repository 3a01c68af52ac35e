"""Draws one world state as an RGB image, with numpy alone.

The view is fixed to the arena; x points right and y up. Robots have their true radius (at least 3 px) and their group's
colour. A learning robot is black with a ring in its group's colour; a single one's sensing disc of radius R2 is shaded.
Goals are hollow squares; those of learning robots have a black outline. Shapes outside the view are clipped.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_core.config import WorldConfig
from sim_core.scenes.base import GOAL_HALF_SIDE_M

Floats = NDArray[np.floating]
Shape = Callable[[Floats, Floats], Floats]
"""Coverage in [0, 1] of the pixels whose centres lie (dx, dy) px from the shape's centre; dx and dy broadcast."""

GROUP_COLOURS = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#D55E00",
    "#F0E442",
    "#882255",
    "#999933",
    "#332288",
)
"""Colours of groups 0, 1, ..., repeated cyclically: Okabe and Ito's seven, then three of Paul Tol's muted scheme."""

MIN_ROBOT_RADIUS_PX = 3.0
WHITE, BLACK, OUTLINE, ARENA, SENSING = "#FFFFFF", "#000000", "#4A4A4A", "#DADDE1", "#666666"


def colour_rgb(colour: str) -> NDArray[np.uint8]:
    """Red, green and blue `[3]` of a colour `#RRGGBB`."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


def group_rgb(groups: int) -> NDArray[np.uint8]:
    """Colours `[groups, 3]` of groups 0 to `groups` - 1."""
    return np.stack([colour_rgb(GROUP_COLOURS[group % len(GROUP_COLOURS)]) for group in range(groups)])


def view_half_m(config: WorldConfig) -> float:
    """Half the edge length of the square view around the arena's centre, metres. All starts and goals lie inside."""
    return config.scene_class.view_half_m(config)


def to_pixels(point_m: ArrayLike, config: WorldConfig, size_px: int) -> Floats:
    """Image coordinates (column, row) `[..., 2]` of points `[..., 2]` in metres. Pixel (0, 0) has its centre at 0.5."""
    half_m = view_half_m(config)
    return (np.asarray(point_m, np.float64) * (1.0, -1.0) / half_m + 1.0) * (0.5 * size_px)


def draw_world(
    position: NDArray[np.floating],
    goal: NDArray[np.floating],
    learners: int | Sequence[int] | NDArray[np.integer],
    config: WorldConfig,
    size_px: int = 480,
) -> NDArray[np.uint8]:
    """Draws one world.

    Args:
      position: `[num_robots, 2]`, metres; group after group (`config.group_sizes`); NaN: has left the world.
      goal: `[groups, 2]`, metres.
      learners: index of the learning robot, or of all of them.
      config: the setup.
      size_px: edge length of the square image.

    Returns:
      The image `[size_px, size_px, 3]` uint8, RGB.
    """
    image = _background(config, size_px).copy()
    px_per_m = 0.5 * size_px / view_half_m(config)
    radius_px = max(config.robot_radius_m * px_per_m, MIN_ROBOT_RADIUS_PX)
    robot_px, goal_px = to_pixels(position, config, size_px), to_pixels(goal, config, size_px)
    colours = group_rgb(config.groups)
    group = np.repeat(np.arange(config.groups), config.group_sizes)
    there = np.isfinite(robot_px).all(axis=1)
    learning = np.zeros(len(robot_px), np.bool_)
    learning[np.atleast_1d(learners)] = True

    _draw_goals(image, goal_px, GOAL_HALF_SIDE_M * px_per_m, colours, sorted({int(own) for own in group[learning]}))
    if learning.sum() == 1:
        _draw_sensing(image, robot_px[learning & there], config.outer_radius_m * px_per_m)
    swarm = ~learning & there
    swarm_colours = colours[group[swarm]]
    _splat_discs(image, robot_px[swarm], radius_px + 0.6, np.broadcast_to(colour_rgb(OUTLINE), swarm_colours.shape))
    _splat_discs(image, robot_px[swarm], radius_px - 0.4, swarm_colours)
    for robot in np.flatnonzero(learning & there):
        _draw_learner(image, robot_px[robot], radius_px, colours[group[robot]])
    return image


@functools.lru_cache(maxsize=8)
def _background(config: WorldConfig, size_px: int) -> NDArray[np.uint8]:
    """White image `[size_px, size_px, 3]` with the circle of the group centres; it is cached and read-only."""
    image = np.full((size_px, size_px, 3), 255, np.uint8)
    if not config.scene_class.draws_circle:
        image.setflags(write=False)
        return image
    centre, edge = to_pixels((0.0, 0.0), config, size_px), to_pixels((config.arena_radius_m, 0.0), config, size_px)
    radius_px = float(edge[0] - centre[0])
    _paint(image, centre, radius_px + 1.0, _ring(radius_px, 1.5), ARENA)
    image.setflags(write=False)
    return image


def _draw_goals(
    image: NDArray[np.uint8], goal_px: Floats, half_px: float, colours: NDArray[np.uint8], own_groups: list[int]
) -> None:
    half_px = max(half_px, 5.0)
    line_px = max(2.0, 0.25 * half_px)
    for group, centre in enumerate(goal_px):
        if group in own_groups:
            _paint(image, centre, half_px + 1.5, _frame(half_px + 1.5, line_px + 3.0), BLACK)
        _paint(image, centre, half_px, _frame(half_px, line_px), colours[group])


def _draw_sensing(image: NDArray[np.uint8], centres_px: Floats, radius_px: float) -> None:
    for centre_px in centres_px:
        _paint(image, centre_px, radius_px, _disc(radius_px), SENSING, opacity=0.2)
        _paint(image, centre_px, radius_px + 1.0, _ring(radius_px, 1.2), SENSING, opacity=0.7)


def _draw_learner(image: NDArray[np.uint8], centre_px: Floats, radius_px: float, colour: NDArray[np.uint8]) -> None:
    _paint(image, centre_px, radius_px + 4.0, _disc(radius_px + 4.0), BLACK)
    _paint(image, centre_px, radius_px + 3.0, _disc(radius_px + 3.0), colour)
    _paint(image, centre_px, radius_px + 0.3, _disc(radius_px + 0.3), BLACK)


def _disc(radius_px: float) -> Shape:
    return lambda dx, dy: np.clip(radius_px + 0.5 - np.sqrt(dx * dx + dy * dy), 0.0, 1.0)


def _ring(radius_px: float, line_px: float) -> Shape:
    return lambda dx, dy: np.clip(0.5 * line_px + 0.5 - np.abs(np.sqrt(dx * dx + dy * dy) - radius_px), 0.0, 1.0)


def _frame(half_px: float, line_px: float) -> Shape:
    """A hollow square: the box of half edge `half_px` minus the box smaller by `line_px` on every side."""

    def box(dx: Floats, dy: Floats, half: float) -> Floats:
        return np.clip(half + 0.5 - np.abs(dx), 0.0, 1.0) * np.clip(half + 0.5 - np.abs(dy), 0.0, 1.0)

    return lambda dx, dy: box(dx, dy, half_px) - box(dx, dy, half_px - line_px)


def _paint(
    image: NDArray[np.uint8],
    centre_px: Floats,
    extent_px: float,
    shape: Shape,
    colour: str | NDArray[np.uint8],
    opacity: float = 1.0,
) -> None:
    """Blends one shape of half extent `extent_px` into `image` `[height, width, 3]`, in place."""
    rgb = (colour_rgb(colour) if isinstance(colour, str) else colour).astype(np.float32)
    limit = np.array(image.shape[1::-1])
    low = np.clip(np.floor(centre_px - extent_px - 1.0), 0, limit).astype(np.int64)
    high = np.clip(np.ceil(centre_px + extent_px + 1.0), 0, limit).astype(np.int64)
    dx = (np.arange(low[0], high[0]) + 0.5 - centre_px[0]).astype(np.float32)
    dy = (np.arange(low[1], high[1])[:, None] + 0.5 - centre_px[1]).astype(np.float32)
    patch = image[low[1] : high[1], low[0] : high[0]]
    alpha = opacity * shape(dx, dy)[..., None]
    patch[...] = np.rint(patch + alpha * (rgb - patch))


def _splat_discs(image: NDArray[np.uint8], centre_px: Floats, radius_px: float, colours: NDArray[np.uint8]) -> None:
    """Blends discs of one radius into `image` `[size, size, 3]`, all at once, so that their order does not matter.

    Args:
      image: changed in place.
      centre_px: `[num_discs, 2]`, column and row.
      radius_px: the discs' radius.
      colours: `[num_discs, 3]` uint8; where discs overlap, their colours mix.
    """
    size = image.shape[0]
    extent = int(np.ceil(radius_px)) + 1
    near = np.floor(centre_px).astype(np.int64)[:, :, None] + np.arange(-extent, extent + 1)
    columns, rows = near[:, 0], near[:, 1]
    dx, dy = columns + 0.5 - centre_px[:, :1], rows + 0.5 - centre_px[:, 1:]
    cover = _disc(radius_px)(dx[:, None, :], dy[:, :, None])
    visible = ((rows >= 0) & (rows < size))[:, :, None] & ((columns >= 0) & (columns < size))[:, None, :]
    disc, row, column = np.nonzero(visible & (cover > 0.0))
    weight = cover[disc, row, column]
    pixel, slot = np.unique(rows[disc, row] * size + columns[disc, column], return_inverse=True)
    total = np.bincount(slot, weight)[:, None]
    mixed = np.stack([np.bincount(slot, weight * colours[disc, k]) for k in range(3)], axis=-1) / total
    flat = image.reshape(-1, 3)
    flat[pixel] = np.rint(flat[pixel] + np.minimum(total, 1.0) * (mixed - flat[pixel]))
