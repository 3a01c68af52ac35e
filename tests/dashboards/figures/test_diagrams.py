"""The diagrams, checked with numpy on the state that they are drawn from."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse

from dashboards.figures.diagrams import (
    DIAGRAMS,
    EPISODE_SEED,
    Diagram,
    best_scene,
    diagram_3_1,
    diagram_4_1,
    diagram_4_3,
    executed_velocity,
    field_strength,
    group_ellipses,
    net_counts,
    perceived,
    potential_field,
    robots_near,
)
from dashboards.figures.style import save_png
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch

SENSOR_WORLD = WorldConfig(robots=10, groups=3, method="sensor")
OUTSIDE_WORLD = WorldConfig(robots=10, groups=3, method="out", learner_speed_limit_m_s=1.2)


@pytest.fixture(scope="module")
def near() -> WorldBatch:
    return best_scene(SENSOR_WORLD, EPISODE_SEED, robots_near)


@pytest.fixture(scope="module")
def pushed() -> WorldBatch:
    return best_scene(OUTSIDE_WORLD, EPISODE_SEED, field_strength)


def seen_by_hand(worlds: WorldBatch) -> tuple[np.ndarray, np.ndarray, int]:
    """Offsets of the other robots, whether each is of the own group, and the learning robot's index."""
    learner, robots = int(worlds.state.learner[0]), worlds.config.robots
    position = worlds.positions()[0].astype(np.float64)
    others = np.delete(np.arange(len(position)), learner)
    return position[others] - position[learner], others // robots == learner // robots, learner


def arrow_tips(figure: Figure, axes: int) -> list[tuple[float, float]]:
    arrows = [text for text in figure.axes[axes].texts if getattr(text, "arrow_patch", None) is not None]
    return [text.xy for text in arrows]  # type: ignore[attr-defined]


def test_the_scene_is_the_step_with_most_robots_in_range(near: WorldBatch):
    worlds = WorldBatch(SENSOR_WORLD, 1)
    worlds.seed([EPISODE_SEED])
    worlds.reset()
    most, at, outcome = robots_near(worlds), 0, int(Outcome.RUNNING)
    while outcome == Outcome.RUNNING:
        outcome = int(worlds.step(Pilot.FREE).outcome[0])
        offsets, _, _ = seen_by_hand(worlds)
        found = np.sum(np.hypot(*offsets.T) < SENSOR_WORLD.outer_radius_m)
        if found > most:
            most, at = found, int(worlds.state.steps[0])
    assert (int(near.state.steps[0]), robots_near(near)) == (at, most)
    assert at > 50 and most > SENSOR_WORLD.robots, "in mid-episode, near other groups"


def test_counts_are_those_of_a_count_by_hand(near: WorldBatch):
    offsets, own, _ = seen_by_hand(near)
    q, wanted = SENSOR_WORLD.sectors, np.zeros((2, SENSOR_WORLD.sectors), int)
    for (dx, dy), mate in zip(offsets, own, strict=True):
        distance, sector = math.hypot(dx, dy), int((math.atan2(dy, dx) + math.pi) / (2 * math.pi / q))
        if distance < SENSOR_WORLD.outer_radius_m:
            wanted[int(distance >= SENSOR_WORLD.inner_radius_m), sector] += 1 if mate else -1
    assert net_counts(near).tolist() == wanted.tolist()
    assert np.any(wanted > 0) and np.any(wanted < 0)


def test_counts_are_written_into_their_regions(near: WorldBatch):
    counts, q = net_counts(near), SENSOR_WORLD.sectors
    written = {}
    for text in diagram_3_1(SENSOR_WORLD).axes[1].texts:
        (x, y), label = text.get_position(), text.get_text().replace("−", "-")
        if text.get_bbox_patch() is not None:
            ring = int(math.hypot(x, y) >= SENSOR_WORLD.inner_radius_m)
            written[ring, int((math.atan2(y, x) + math.pi) / (2 * math.pi / q))] = int(label)
    assert written == {(ring, sector): counts[ring, sector] for ring in range(2) for sector in range(q)}


def test_separate_counts_are_written_side_by_side(near: WorldBatch):
    world = dataclasses.replace(SENSOR_WORLD, sensor_counts="separate")
    worlds = best_scene(world, EPISODE_SEED, robots_near)
    own, others = perceived(worlds)
    assert (own - others).tolist() == net_counts(near).tolist() == net_counts(worlds).tolist()
    texts = [text.get_text() for text in diagram_3_1(world).axes[1].texts if text.get_bbox_patch() is not None]
    wanted = [f"{mine}|{theirs}" for mine, theirs in zip(own.flat, others.flat, strict=True)]
    assert texts == wanted


def test_the_heading_points_into_the_sector_of_the_highest_count(near: WorldBatch):
    best = int(np.argmax(net_counts(near).sum(axis=0)))
    middle = -math.pi + (best + 0.5) * 2 * math.pi / SENSOR_WORLD.sectors
    (tip,) = arrow_tips(diagram_3_1(SENSOR_WORLD), axes=1)
    assert math.atan2(tip[1], tip[0]) == pytest.approx(middle, abs=1e-6)
    assert f"heading {best}" in diagram_3_1(SENSOR_WORLD).axes[1].get_title(loc="left")


def test_sectors_that_face_the_goal_are_drawn_rotated():
    world = dataclasses.replace(SENSOR_WORLD, sector_frame="goal")
    worlds = best_scene(world, EPISODE_SEED, robots_near)
    state, learner = worlds.state, int(worlds.state.learner[0])
    own = learner // world.robots
    towards = (state.goal_y[0, own] - state.pos_y[0, learner], state.goal_x[0, own] - state.pos_x[0, learner])
    best = int(np.argmax(net_counts(worlds).sum(axis=0)))
    middle = -math.pi + (best + 0.5) * 2 * math.pi / world.sectors + math.atan2(*towards)
    axes = diagram_3_1(world).axes[1]
    (tip,) = (text.xy for text in axes.texts if getattr(text, "arrow_patch", None) is not None)  # type: ignore[attr-defined]
    assert math.cos(math.atan2(tip[1], tip[0]) - middle) == pytest.approx(1.0, abs=1e-6)
    plates = [text for text in axes.texts if text.get_bbox_patch() is not None]
    fullest = plates[best + world.sectors].get_position()
    assert math.cos(math.atan2(fullest[1], fullest[0]) - middle) == pytest.approx(1.0, abs=1e-6)


def test_robots_are_drawn_where_they_are(near: WorldBatch):
    offsets, _, _ = seen_by_hand(near)
    drawn = [patch.center for patch in diagram_3_1(SENSOR_WORLD).axes[0].patches if isinstance(patch, Circle)]
    for offset in offsets:
        assert min(math.dist(offset, centre) for centre in drawn) < 1e-6


@pytest.mark.parametrize(("panel", "covariance"), [(0, "diagonal"), (1, "full")])
def test_ellipses_are_numpys_confidence_regions(panel: int, covariance: str):
    worlds = best_scene(OUTSIDE_WORLD, EPISODE_SEED, robots_near)
    config = dataclasses.replace(OUTSIDE_WORLD, ellipse_covariance=covariance)  # type: ignore[arg-type]
    patches = [
        patch
        for patch in diagram_4_1(OUTSIDE_WORLD).axes[panel].patches
        if type(patch) is Ellipse and not patch.get_fill()
    ]
    position, learner = worlds.positions()[0].astype(np.float64), int(worlds.state.learner[0])
    assert len(patches) == config.groups
    for group, (found, patch) in enumerate(zip(group_ellipses(worlds, config), patches, strict=True)):
        members = np.setdiff1d(np.arange(group * config.robots, (group + 1) * config.robots), [learner])
        spread = np.cov(position[members].T)
        spread = np.diag(np.diag(spread)) if covariance == "diagonal" else spread
        half = np.sqrt(5.991 * np.linalg.eigvalsh(spread))
        assert found[:2] == pytest.approx(half, rel=1e-4)
        assert (patch.get_height(), patch.get_width()) == pytest.approx(2 * half, rel=1e-4)
        assert patch.center == pytest.approx(position[members].mean(axis=0) - position[learner], abs=1e-4)
        along = np.linalg.eigh(spread)[1][:, 1]
        turn = math.radians(patch.angle)
        assert abs(along @ [math.cos(turn), math.sin(turn)]) == pytest.approx(1.0, abs=1e-4)


def test_the_field_is_the_negative_gradient_of_the_potential(pushed: WorldBatch):
    offsets, _, _ = seen_by_hand(pushed)
    config = pushed.config

    def potential(at: np.ndarray) -> float:
        near = np.minimum(np.hypot(*(offsets - at).T), config.apf_range_m)
        return float(np.sum(0.5 * config.apf_gain_m4_s * (1 / near - 1 / config.apf_range_m) ** 2))

    step = 1e-5
    slopes = [(potential(step * axis) - potential(-step * axis)) / (2 * step) for axis in np.eye(2)]
    assert potential_field(pushed) == pytest.approx(-np.array(slopes), abs=1e-3)
    assert np.hypot(*slopes) > 0.2, "the field is large enough to be seen"


def test_the_arrows_add_up(pushed: WorldBatch):
    network, field, moved = (np.array(tip) for tip in arrow_tips(diagram_4_3(OUTSIDE_WORLD), axes=0))
    total = network + field
    limit = pushed.config.learner_speed_limit_m_s
    assert moved == pytest.approx(total * min(1.0, limit / np.hypot(*total)), abs=1e-5)
    assert field == pytest.approx(potential_field(pushed)) and np.hypot(*network) == pytest.approx(1.0)
    offsets, own, _ = seen_by_hand(pushed)
    headings = -math.pi + (np.arange(8) + 0.5) * math.pi / 4
    towards = offsets[own].mean(axis=0)
    nearest = int(np.argmax(np.cos(headings - math.atan2(towards[1], towards[0]))))
    assert math.atan2(network[1], network[0]) == pytest.approx(headings[nearest])
    assert executed_velocity(pushed, nearest) == pytest.approx(moved)


@pytest.mark.parametrize("diagram", DIAGRAMS, ids=lambda diagram: diagram.file)
def test_files_are_small_and_reproducible(diagram: Diagram, tmp_path: Path):
    for name in ("first.png", "second.png"):
        save_png(diagram.draw(WorldConfig(method=diagram.method, robots=10, groups=3)), tmp_path / name)
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()
    assert (tmp_path / "first.png").stat().st_size <= 60 * 1024


def test_an_episode_of_falling_score_gives_its_start():
    worlds = best_scene(WorldConfig(robots=5, groups=2), 3, lambda batch: -float(batch.state.steps[0]))
    assert int(worlds.state.steps[0]) == 0
