"""The player: its data against the episode, its escaping, and its behaviour in Chromium."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.evaluation.evaluator import record_episode
from actors.evaluation.trajectory import Episode
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from dashboards.pages.player import VERDICTS, player_data, player_html
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED, OUTCOME_NAMES, Outcome
from sim_core.render import GROUP_COLOURS, colour_rgb, to_pixels
from tests.dashboards.chromium import complaints, emulate_scheme, emulate_width, press, two_frames, wait_until

EVIL = '</script><img src=x onerror="window.evil=1"> & {{data}} \'`'


def payload(document: str) -> dict[str, Any]:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', document, re.S)
    assert found is not None
    return json.loads(found[1])


def decoded(data: dict[str, Any], key: str, dtype: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(data[key])), dtype)


def decoded_positions(data: dict[str, Any], shape: tuple[int, ...], key: str = "positions") -> np.ndarray:
    low, high = np.split(decoded(data, key, "u1").astype(np.int64), 2)
    units = np.cumsum((low + 256 * high).reshape(shape), axis=0)
    return ((units + 2**15) % 2**16 - 2**15) * data["metres_per_unit"]


def test_positions_are_decoded_within_the_quantisation(episode: Episode, config: WorldConfig):
    data = payload(player_html(episode, config, "title"))
    metres = decoded_positions(data, episode.position.shape)
    np.testing.assert_allclose(metres, episode.position, atol=0.51 * data["metres_per_unit"])
    assert data["metres_per_unit"] <= 0.0005
    machine = decoded(data, "machine", "u1").reshape(episode.machine.shape)
    np.testing.assert_array_equal(machine, episode.machine)
    np.testing.assert_array_equal(decoded(data, "actions", "<i2"), episode.action)
    assert data["steps"] == len(episode.action) - 1
    assert data["learner"] == episode.learner
    np.testing.assert_allclose(data["goals"], episode.goal, atol=1e-4)


def test_velocities_are_the_differences_of_positions(episode: Episode, config: WorldConfig):
    """The player computes velocities from positions, so the recorded ones must agree."""
    data = player_data(episode, config)
    metres = decoded_positions(data, episode.position.shape)
    derived = np.diff(metres, axis=0) / config.time_step_s
    np.testing.assert_allclose(derived, episode.velocity[1:], atol=1.1 * data["metres_per_unit"] / config.time_step_s)


def test_positions_far_outside_do_not_wrap_around(episode: Episode, config: WorldConfig):
    far = episode.position.copy()
    far[-1, 0] = [300.0, -250.0]
    data = player_data(episode._replace(position=far), config)
    metres = decoded_positions(data, far.shape)
    np.testing.assert_allclose(metres[-1, 0], [300.0, -250.0], atol=0.01)


def test_the_data_state_who_drives_the_learning_robot(episode: Episode, failed: Episode, config: WorldConfig):
    assert player_data(episode, config)["piloted"] is False
    assert player_data(failed, config)["piloted"] is True


@pytest.fixture(scope="module")
def impaired_world(config: WorldConfig) -> WorldConfig:
    """A world in which the learning robot senses badly and has a shield."""
    return dataclasses.replace(
        config, position_noise_m=0.1, position_loss=0.3, shield="orca", arena_radius_m=3.0, method="in"
    )


@pytest.fixture(scope="module")
def impaired(impaired_world: WorldConfig) -> Episode:
    """An episode of such a world."""
    return record_episode(EnvSpec(ENV_ID, impaired_world), Baseline.GREEDY, seed=5)


def test_what_is_sensed_and_asked_for_stands_beside_what_is(impaired: Episode, impaired_world: WorldConfig):
    data = player_data(impaired, impaired_world)
    found = decoded_positions(data, impaired.position.shape, "sensed")
    hidden = np.isnan(impaired.sensed)
    assert 0.1 < hidden.mean() < 0.4 and (found[hidden] == -(2**15) * data["metres_per_unit"]).all()
    np.testing.assert_allclose(found[~hidden], impaired.sensed[~hidden], atol=0.51 * data["metres_per_unit"])
    np.testing.assert_allclose(decoded(data, "asked", "<i2").reshape(-1, 2) / 1000, impaired.asked, atol=0.0006)
    driven = impaired.velocity[1:, impaired.learner]
    assert (np.abs(driven - impaired.asked[:-1]).max(axis=1) > 1e-6).any()


def test_an_episode_without_bad_senses_or_shield_says_nothing_of_them(episode: Episode, config: WorldConfig):
    data = player_data(episode, config)
    assert data["sensed"] is None and data["asked"] is None


def test_three_hundred_steps_of_twenty_robots_are_small(config: WorldConfig):
    big = WorldConfig(robots=10, groups=2)
    rng = np.random.default_rng(0)
    noise = Episode(
        position=rng.uniform(-6, 6, (301, 20, 2)).astype(np.float32),
        velocity=np.zeros((301, 20, 2), np.float32),
        machine=rng.integers(0, 4, (301, 20)).astype(np.int8),
        action=np.full(301, -1),
        reward=np.zeros(301, np.float32),
        goal=np.zeros((2, 2), np.float32),
        learner=0,
        outcome=int(Outcome.GOAL),
        seed=0,
    )
    assert len(player_html(noise, big, "title").encode()) < 100 * 1024


def test_the_document_links_to_nothing(episode: Episode, config: WorldConfig):
    document = player_html(episode, config, "title")
    links = set(re.findall(r"https?://[^\"' ]+", document))
    assert links == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\bsrc\s*=|@import|url\(|fetch\(|XMLHttpRequest|localStorage", document)
    assert "{{" not in document


@pytest.mark.parametrize("outcome", ENDED)
def test_outcome_is_stated(episode: Episode, config: WorldConfig, outcome: Outcome):
    document = player_html(episode._replace(outcome=int(outcome)), config, "title")
    steps = len(episode.position) - 1
    assert payload(document)["verdict"] == f"{VERDICTS[outcome]} (step {steps}, {steps * config.time_step_s:.2f} s)."
    assert payload(document)["outcome"] == OUTCOME_NAMES[outcome]


def test_the_title_is_escaped(episode: Episode, config: WorldConfig):
    document = player_html(episode, config, EVIL)
    assert "<img" not in document
    assert document.count("</script>") == 2
    assert payload(document) == payload(player_html(episode, config, "title"))


def test_refuses_what_it_cannot_draw(episode: Episode, config: WorldConfig):
    broken = episode.position.copy()
    broken[3, 1, 0] = np.nan
    with pytest.raises(ValueError, match="finite: False"):
        player_html(episode._replace(position=broken), config, "title")
    with pytest.raises(ValueError, match="12"):
        player_html(episode, WorldConfig(robots=6, groups=2), "title")


@pytest.fixture
def page(browser: Any, failed: Episode, config: WorldConfig, tmp_path: Path) -> Iterator[Any]:
    """The player of the failed episode, opened from disk; the test fails on an error in the console."""
    path = tmp_path / "player.html"
    path.write_text(player_html(failed, config, EVIL), encoding="utf-8")
    open_player(browser, path)
    yield browser
    assert complaints(browser) == []


def test_chromium_draws_what_is_sensed(browser: Any, impaired: Episode, impaired_world: WorldConfig, tmp_path: Path):
    path = tmp_path / "player.html"
    path.write_text(player_html(impaired, impaired_world, "title"), encoding="utf-8")
    open_player(browser, path)
    found = browser.execute_script("return [Array.from(sensed, x => isNaN(x) ? null : x), Array.from(asked)]")
    sensed = np.array(found[0], float).reshape(impaired.sensed.shape)
    np.testing.assert_allclose(sensed, impaired.sensed, atol=0.001)
    np.testing.assert_allclose(np.array(found[1]).reshape(-1, 2) / 1000, impaired.asked, atol=0.0006)
    picture = "return canvas.toDataURL()"
    browser.execute_script("element('velocity').click(); seek(3)")
    with_rings = browser.execute_script(picture)
    browser.execute_script("element('sensed').click()")
    assert browser.execute_script(picture) != with_rings
    shown = "return ['sensed-toggle', 'asked-note'].map(id => !element(id).hidden)"
    assert browser.execute_script(shown) == [True, True]
    assert complaints(browser) == []


def test_chromium_offers_nothing_that_an_episode_lacks(page: Any):
    hidden = "return ['sensed-toggle', 'asked-note'].map(id => element(id).hidden)"
    assert page.execute_script(hidden) == [True, True]


def open_player(browser: Any, path: Path) -> None:
    browser.get(path.as_uri())
    wait_until(browser, "data !== null && element('readout').textContent !== ''")


def read_step(page: Any) -> int:
    return int(page.execute_script("return document.getElementById('readout').textContent.match(/\\d+/)[0]"))


def canvas_pixel(page: Any, point_m: np.ndarray, config: WorldConfig) -> np.ndarray:
    size = int(page.execute_script("return document.getElementById('canvas').width"))
    column, row = to_pixels(point_m, config, size).astype(int).tolist()
    script = "return Array.from(canvas.getContext('2d').getImageData(arguments[0], arguments[1], 1, 1).data)"
    return np.array(page.execute_script(script, column, row)[:3])


def test_chromium_keys_move_between_steps(page: Any, failed: Episode):
    from selenium.webdriver.common.keys import Keys

    last = len(failed.action) - 1
    moves = [(Keys.ARROW_RIGHT, 1), (Keys.ARROW_RIGHT, 2), (Keys.ARROW_LEFT, 1), (Keys.END, last), (Keys.HOME, 0)]
    for key, expected in moves:
        press(page, key)
        assert read_step(page) == expected
    press(page, Keys.ARROW_LEFT)
    assert read_step(page) == 0
    press(page, Keys.SPACE)
    page.execute_async_script("setTimeout(arguments[0], 400)")
    press(page, Keys.SPACE)
    stopped = read_step(page)
    assert 0 < stopped < last
    page.execute_async_script("setTimeout(arguments[0], 200)")
    assert read_step(page) == stopped


def test_chromium_plays_to_the_end_and_starts_over(page: Any, failed: Episode):
    last = len(failed.action) - 1
    page.execute_script("element('speed').value = '8'; element('play').click()")
    page.execute_async_script("const f = arguments[0]; (function w() { playing ? setTimeout(w, 20) : f(); })()")
    assert read_step(page) == last
    assert page.execute_script("return element('play').textContent") == "Play"
    page.execute_script("element('play').click(); element('play').click()")
    assert read_step(page) < last


def test_chromium_scrubs_and_draws_the_robots_there(page: Any, failed: Episode, config: WorldConfig):
    step = len(failed.action) // 2
    script = "const s = element('scrub'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))"
    page.execute_script(script, step)
    assert read_step(page) == step
    for robot, point in enumerate(failed.position[step]):
        colour = "#000000" if robot == failed.learner else GROUP_COLOURS[robot // config.robots]
        seen = canvas_pixel(page, point, config)
        assert np.abs(seen - colour_rgb(colour)).max() <= 4, (robot, seen)


def test_chromium_marks_the_failure_at_the_last_step_only(page: Any, failed: Episode, config: WorldConfig):
    mark = colour_rgb("#B3261E").astype(int)
    last = len(failed.action) - 1
    for step, marked in ((last, True), (last - 1, False)):
        page.execute_script("seek(arguments[0])", step)
        seen = canvas_pixel(page, failed.position[step, failed.learner], config)
        assert (np.abs(seen - mark).max() <= 4) == marked
        text = page.execute_script("return element('readout').textContent")
        assert text.endswith(", lost") == marked


def test_chromium_counts_the_states(page: Any, failed: Episode):
    page.execute_script("element('machine').click(); seek(10)")
    counts = [page.execute_script(f"return element('state-count-{state}').textContent") for state in range(4)]
    swarm = np.delete(failed.machine[10], failed.learner)
    assert [int(count) for count in counts] == np.bincount(swarm, minlength=4).tolist()


def test_chromium_title_is_text_and_controls_have_names(page: Any):
    assert page.title == EVIL
    assert page.execute_script("return window.evil === undefined && !document.querySelector('img')")
    unnamed = """return [...document.querySelectorAll('button, input, select')].filter(
        e => !(e.getAttribute('aria-label') || e.textContent.trim() && e.tagName === 'BUTTON' || e.labels.length))"""
    assert page.execute_script(f"{unnamed}.length") == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_chromium_follows_the_colour_scheme(page: Any, scheme: str, config: WorldConfig):
    with emulate_scheme(page, scheme):
        two_frames(page)
        brightness = canvas_pixel(page, np.array([0.0, 0.0]), config).mean()
    assert (brightness > 200) == (scheme == "light")


def test_chromium_fits_a_narrow_screen(page: Any):
    with emulate_width(page, 340):
        widths = page.execute_script("return [document.documentElement.scrollWidth, canvas.clientWidth]")
    assert widths[0] <= 340
    assert widths[1] > 280
