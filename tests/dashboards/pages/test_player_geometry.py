"""Geometry that the player computes, in Chromium: ellipses against the simulator, ORCA's lines against RVO2."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.evaluation.trajectory import Episode
from dashboards.pages.player import player_html
from sim_core.config import WorldConfig
from sim_core.methods.ellipse import ellipse_params, group_ellipse, left_out_of
from sim_core.methods.headings import heading_velocities
from tests.dashboards.chromium import complaints, wait_until
from tests.dashboards.conftest import record_episode
from tests.sim_core.orca_scenes import Scene
from tests.sim_core.parity import rvo2_half_planes, rvo2_step, worst_violation

OUT = WorldConfig(robots=4, groups=3, method="out")
STEPS = (1, 40, 90)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return record_episode(OUT, seed=5, action=2)


def opened(browser: Any, episode: Episode, config: WorldConfig, folder: Path) -> Any:
    path = folder / "player.html"
    path.write_text(player_html(episode, config, "geometry"), encoding="utf-8")
    browser.get(path.as_uri())
    wait_until(browser, "data !== null")
    return browser


@pytest.fixture
def page(browser: Any, episode: Episode, tmp_path: Path) -> Iterator[Any]:
    yield opened(browser, episode, OUT, tmp_path)
    assert complaints(browser) == []


@pytest.mark.parametrize("settings", [{}, {"ellipse_covariance": "full"}, {"ellipse_counts_learner": True}])
def test_ellipses_are_those_of_the_simulator(browser: Any, episode: Episode, tmp_path: Path, settings: dict[str, Any]):
    config = WorldConfig(robots=4, groups=3, method="out", **settings)
    params = ellipse_params(config)
    page = opened(browser, episode, config, tmp_path)
    for step in STEPS:
        page.execute_script("seek(arguments[0])", step)
        pos_x, pos_y = episode.position[step].astype(np.float64).T.copy()
        for group in range(config.groups):
            drawn = page.execute_script("return ellipseOf(arguments[0])", group)
            left_out = left_out_of(episode.learner, params)
            minor, major, x, y, turn = group_ellipse(group * 4, (group + 1) * 4, pos_x, pos_y, left_out, params)
            seen = [drawn[name] for name in ("minor", "major", "x", "y")]
            np.testing.assert_allclose(seen, [minor, major, x, y], atol=0.002)
            assert abs(np.sin(drawn["turn"] - turn)) < 0.02  # an ellipse rotated by half a turn is the same


def test_the_drawn_heading_is_the_executed_one(page: Any, episode: Episode):
    headings = heading_velocities(OUT, np.float64)
    for action in range(OUT.sectors):
        turn = page.execute_script("return headingOf(arguments[0])", action)
        np.testing.assert_allclose([np.cos(turn), np.sin(turn)], headings[action], atol=1e-6)
    assert page.execute_script("return actions[5]") == episode.action[5]


def test_sectors_that_face_the_goal_are_drawn_rotated(page: Any, episode: Episode):
    step = STEPS[1]
    page.execute_script("data.sectors_face_goal = true; seek(arguments[0])", step)
    towards = episode.goal[episode.learner // OUT.robots] - episode.position[step, episode.learner]
    for action, heading in enumerate(heading_velocities(OUT, np.float64)[: OUT.sectors]):
        turn = page.execute_script("return headingOf(arguments[0])", action)
        expected = np.arctan2(*heading[::-1]) + np.arctan2(*towards[::-1])
        np.testing.assert_allclose([np.cos(turn), np.sin(turn)], [np.cos(expected), np.sin(expected)], atol=0.01)
    page.execute_script("data.sectors_face_goal = false")


def test_orca_lines_equal_rvo2s(page: Any, episode: Episode):
    known = np.delete(np.arange(OUT.num_robots), episode.learner)  # M_OUT: the swarm does not know the learning robot
    compared = 0
    for step in STEPS:
        # RVO2 gets the player's own velocities, which are rounded.
        script = """const [step, robots] = arguments;
            const rows = read => robots.map(i => [0, 1].map(axis => read(step, i, axis)));
            return [rows(coordinate), rows(velocityAt)]"""
        position, velocity = np.array(page.execute_script(script, step, known.tolist()), np.float32)
        np.testing.assert_allclose(velocity, episode.velocity[step][known], atol=0.011)
        sim = rvo2_step(Scene(position, velocity, velocity))
        for row, robot in enumerate(known.tolist()):
            theirs = rvo2_half_planes(sim, row)
            script = "return halfPlanes(...arguments).map(p => [p.x, p.y, p.dx, p.dy])"
            lines = np.array(page.execute_script(script, robot, step)).reshape(-1, 4)
            assert len(lines) == len(theirs)
            for line in lines:  # RVO2 orders neighbours at equal distance differently
                assert np.abs(theirs - line).max(axis=1).min() < 1e-3
            compared += len(lines)
    assert compared > 30


def test_the_next_velocity_is_permitted(page: Any, episode: Episode):
    checked = 0
    for step in STEPS:
        for robot in np.delete(np.arange(OUT.num_robots), episode.learner).tolist():
            script = "const p = halfPlanes(...arguments); return [p.map(p => [p.x, p.y, p.dx, p.dy]), permitted(p, 1)]"
            lines, corners = page.execute_script(script, robot, step)
            if not lines or not corners:
                continue
            planes = np.array(lines)
            assert worst_violation(planes, episode.velocity[step + 1, robot]) < 0.03
            assert all(worst_violation(planes, corner) < 1e-6 for corner in corners)
            checked += 1
    assert checked > 10


def test_a_click_on_a_robot_shows_its_lines(page: Any, episode: Episode):
    robot = (episode.learner + 2) % OUT.num_robots
    page.execute_script("element('planes').click(); seek(30)")
    script = """const box = canvas.getBoundingClientRect();
        return [toX(positionOf(arguments[0], 0)) - box.width / 2, toY(positionOf(arguments[0], 1)) - box.height / 2]"""
    x, y = page.execute_script(script, robot)
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(page).move_to_element_with_offset(
        page.find_element("id", "canvas"), round(x), round(y)
    ).click().perform()
    assert page.execute_script("return [element('robot').value, playing]") == [str(robot + 1), False]
    count = page.execute_script("return neighboursOf(selected, 30).length")
    assert page.execute_script("return element('planes-text').textContent").startswith(f"{count} lines")
    page.execute_script(
        "element('robot').value = arguments[0]; element('robot').dispatchEvent(new Event('input'))", episode.learner + 1
    )
    assert "follows its policy" in page.execute_script("return element('planes-text').textContent")
