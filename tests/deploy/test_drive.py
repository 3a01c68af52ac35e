"""The page of `shoal watch --drive`: its answers, and in Chromium a scene that sent keys and a pointer drive."""

from __future__ import annotations

import dataclasses
import json
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.evaluation.evaluator import record_episode
from actors.evaluation.trajectory import BY_HAND, Episode
from actors.policy.baselines import Baseline
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from dashboards.pages.player import player_data
from deploy.drive import PERSON, SCENES, DrivenRun, Result, drive_server, driven_store, load_driven, played, total
from learner.run_folder import RunFolder
from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from tests.dashboards.chromium import complaints, open_chromium, wait_until

WORLD = WorldConfig(robots=3, groups=2, arena_radius_m=2.0, horizon_steps=200)
SPEC = EnvSpec(ENV_ID, WORLD)
SEED = 11
PLAYERS = [PERSON, "policy", "greedy", "fl-orca"]


@pytest.fixture(scope="module")
def weights() -> WeightsSnapshot:
    """A policy that has learned nothing."""
    shape, rng = env_shape(SPEC), np.random.default_rng(0)
    arrays = rng.normal(size=(shape.num_actions, shape.observation_size)), rng.normal(size=shape.num_actions)
    return WeightsSnapshot(7, 0.0, tuple(array.astype(np.float32) for array in arrays))


@pytest.fixture
def run(tmp_path: Path, weights: WeightsSnapshot) -> DrivenRun:
    return DrivenRun(RunFolder(tmp_path), WORLD, weights, SEED)


def drive(run: DrivenRun, number: int, x: float, y: float) -> dict[str, Any]:
    """Drives a scene to its end in one direction; returns the last answer."""
    run.begin({"number": number})
    step, answer = 0, {"outcome": "running"}
    while answer["outcome"] == "running":
        answer = run.move({"step": step, "x": x, "y": y})
        step += len(answer["positions"])
    return answer


def test_a_driven_episode_is_stored_with_what_was_done(run: DrivenRun, tmp_path: Path):
    first = run.begin({"number": 2})
    assert first["steps"] == 0 and first["horizon_steps"] == WORLD.horizon_steps
    answer = drive(run, 2, 3e300, 4e300)  # longer than 1 is as fast as it can
    episode = load_driven(RunFolder(tmp_path), WORLD, SEED + 2)
    assert answer["outcome"] == OUTCOME_NAMES[Outcome(episode.outcome)] != "running"
    assert (episode.action[:-1] == BY_HAND).all()
    np.testing.assert_allclose(
        episode.velocity[1:, episode.learner], [[0.6, 0.8]] * (len(episode.action) - 1), atol=1e-6
    )
    np.testing.assert_allclose(np.reshape(answer["positions"][-1], (-1, 2)), episode.position[-1], atol=6e-4)
    same_start = record_episode(SPEC, Baseline.GREEDY, SEED + 2)
    np.testing.assert_array_equal(episode.position[0], same_start.position[0])
    assert player_data(episode, WORLD)["piloted"] is True


def test_the_score_sheet_has_every_player_on_the_driven_scenes(
    run: DrivenRun, weights: WeightsSnapshot, tmp_path: Path
):
    assert run.sheet({}) == {"scenes": SCENES, "next": 0, "players": PLAYERS, "rows": [], "totals": []}
    drive(run, 0, 0.0, 0.0)
    drive(run, 2, 1.0, 0.0)
    sheet = run.sheet({})
    assert sheet["next"] == 1 and [row["number"] for row in sheet["rows"]] == [0, 2]
    for player, candidate in (("policy", weights), ("greedy", Baseline.GREEDY), ("fl-orca", Baseline.FL_ORCA)):
        for row in sheet["rows"]:
            episode = record_episode(SPEC, candidate, SEED + row["number"])
            result = row["results"][player]
            assert result["outcome"] == OUTCOME_NAMES[Outcome(episode.outcome)]
            assert result["time_s"] == pytest.approx(0.05 * (len(episode.position) - 1))
            shown = run.episode({"number": str(row["number"]), "player": player})
            assert shown == player_data(episode, WORLD)
            path = run.paths({"number": str(row["number"])})[player]
            np.testing.assert_allclose(path, episode.position[:, episode.learner], atol=6e-4)
    lines = {line["player"]: line for line in sheet["totals"]}
    assert list(lines) == PLAYERS and all(line["scenes"] == 2 for line in lines.values())
    assert lines["fl-orca"]["successes"] == sum(row["results"]["fl-orca"]["outcome"] == "goal" for row in sheet["rows"])
    json.dumps(sheet, allow_nan=False)

    later = DrivenRun(RunFolder(tmp_path), WORLD, weights, SEED)  # another day
    assert later.sheet({}) == sheet
    other_world = DrivenRun(RunFolder(tmp_path), dataclasses.replace(WORLD, position_loss=0.5), weights, SEED)
    assert other_world.sheet({})["next"] == 0


def test_results_against_plain_arithmetic():
    position = np.zeros((3, 6, 2), np.float32)
    position[:, 1:] = [50.0, 50.0]
    position[:, 0] = [[0, 0], [3, 4], [6, 8]]
    position[1, 4] = [3.0, 4.5]
    episode = Episode(
        position=position,
        velocity=np.zeros_like(position),
        machine=np.zeros((3, 6), np.int8),
        action=np.zeros(3, np.int64),
        reward=np.zeros(3, np.float32),
        goal=np.array([[3, 0], [9, 9]], np.float32),
        learner=0,
        outcome=int(Outcome.GOAL),
        seed=0,
    )
    result = played(episode, WORLD).result
    assert result == Result("goal", pytest.approx(0.1), pytest.approx(3.0), pytest.approx(0.5 - 0.2))
    line = total("you", [result, result._replace(outcome="lost", time_s=9.0, goal_m=5.0)])
    assert (line.scenes, line.successes, line.time_s, line.goal_m) == (2, 1, pytest.approx(0.1), pytest.approx(4.0))
    assert total("you", [result._replace(outcome="lost")]).time_s is None


def test_bad_senses_reach_the_page(tmp_path: Path, weights: WeightsSnapshot):
    world = dataclasses.replace(WORLD, position_loss=0.5)
    run = DrivenRun(RunFolder(tmp_path), world, weights, SEED)
    run.begin({"number": 0})
    sensed = np.array(run.move({"step": 0, "x": 0, "y": 0})["sensed"], float)
    recorded = record_episode(EnvSpec(ENV_ID, world), Baseline.FL_ORCA, SEED).sensed[1].ravel()
    np.testing.assert_array_equal(np.isnan(sensed[0]), np.isnan(recorded))
    assert np.isnan(sensed).any()


def test_what_a_page_must_not_do_is_refused(run: DrivenRun):
    with pytest.raises(ConfigError, match="lost its scene; reload"):
        run.move({"step": 0, "x": 0, "y": 0})
    for number in (SCENES, -1, "0", None):
        with pytest.raises(LookupError, match="scene"):
            run.begin({"number": number})
    run.begin({"number": 0})
    for x, y in ((math.nan, 0), (0, math.inf), ("1", 0), (None, 0), (10**400, 0)):
        with pytest.raises(ValueError, match="a velocity is two numbers"):
            run.move({"step": 0, "x": x, "y": y})
    with pytest.raises(ConfigError, match="lost its scene"):
        run.move({"step": 1, "x": 0, "y": 0})  # another page is ahead
    with pytest.raises(LookupError, match="driven scene 0"):
        run.paths({"number": "0"})
    drive(run, 0, 1.0, 0.0)
    with pytest.raises(ConfigError, match="scene 1 has been driven"):
        run.begin({"number": 0})
    with pytest.raises(LookupError, match="nobody"):
        run.episode({"number": "0", "player": "nobody"})


def test_a_damaged_episode_is_named(run: DrivenRun, tmp_path: Path):
    with pytest.raises(ConfigError, match="nobody has driven scene 11"):
        load_driven(RunFolder(tmp_path), WORLD, SEED)
    drive(run, 0, 1.0, 0.0)
    (driven_store(RunFolder(tmp_path), WORLD, SEED) / "zarr.json").unlink()
    with pytest.raises(ConfigError, match="drive again"):
        run.paths({"number": "0"})


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with open_chromium(tmp_path_factory.mktemp("chromium")) as chromium:
        yield chromium


@contextmanager
def opened(browser: Any, folder: Path, weights: WeightsSnapshot) -> Iterator[None]:
    """The page of a run in `folder`, ready to drive; the test fails on an error in the console."""
    server = drive_server(RunFolder(folder), WORLD, weights, SEED, 0)
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        browser.get(server.url)
        wait_until(browser, "driving && data !== null")
        yield
        assert complaints(browser) == []
    finally:
        server.close()
        thread.join(20)


def learner_at(browser: Any) -> np.ndarray:
    return np.array(browser.execute_script("return [0, 1].map(axis => positionOf(data.learner, axis))"))


def test_chromium_keys_drive_a_scene_to_its_end(browser: Any, tmp_path: Path, weights: WeightsSnapshot):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    def hold(*keys: str) -> None:
        actions = ActionChains(browser)
        for key in keys:
            actions.key_down(key)
        actions.perform()

    with opened(browser, tmp_path, weights):
        assert "Scene 1 of 25" in browser.find_element("id", "status").text
        browser.execute_script("element('speed').value = '8'")
        start = learner_at(browser)
        assert browser.execute_script("return step") == 0
        hold(Keys.ARROW_RIGHT)
        wait_until(browser, "step >= 3")
        hold(Keys.ARROW_UP)  # both: diagonally
        wait_until(browser, "step >= 8")
        hold(Keys.SPACE)
        wait_until(browser, "paused")
        ActionChains(browser).key_up(Keys.ARROW_RIGHT).key_up(Keys.ARROW_UP).perform()
        wait_until(browser, "!moving")
        stopped = browser.execute_script("return step")
        moved = learner_at(browser) - start
        assert stopped < WORLD.horizon_steps and moved[0] > moved[1] > 0
        browser.execute_async_script("setTimeout(arguments[0], 200)")
        assert browser.execute_script("return step") == stopped  # a pause
        browser.execute_script("element('speed').value = '0.25'")
        hold(Keys.ARROW_LEFT, Keys.SPACE, Keys.ARROW_LEFT)  # a pause that ends before it has begun
        wait_until(browser, f"step >= {stopped + 3}")
        browser.execute_script("element('speed').value = '8'")
        hold(Keys.ARROW_LEFT)
        wait_until(browser, "paths !== null && shown === 'you'")
        ActionChains(browser).key_up(Keys.ARROW_LEFT).perform()

        episode = load_driven(RunFolder(tmp_path), WORLD, SEED)
        velocity = episode.velocity[1:, episode.learner]
        headings = [np.float32([1, 0]), np.float32([0.5**0.5, 0.5**0.5]), np.float32([-1, 0])]
        counts = [int((np.abs(velocity - heading) < 1e-5).all(axis=1).sum()) for heading in headings]
        assert all(counts) and sum(counts) == len(velocity)
        outcome = OUTCOME_NAMES[Outcome(episode.outcome)]
        buttons = browser.find_elements("css selector", "#players button")
        assert [button.text.split(":")[0] for button in buttons] == PLAYERS
        assert outcome in buttons[0].text
        cells = [cell.text for cell in browser.find_elements("css selector", "#totals tr:nth-child(2) > *")]
        assert cells[:2] == ["you", f"{int(outcome == 'goal')} of 1"] and float(cells[3]) > 0
        buttons[3].click()
        wait_until(browser, "shown === 'fl-orca' && playing")
        assert browser.execute_script("return data.piloted") is False
        browser.find_element("xpath", "//button[.='Next scene']").click()
        wait_until(browser, "driving && number === 1 && step === 0")
        assert "Scene 2 of 25" in browser.find_element("id", "status").text


def test_chromium_the_pointer_drives_and_a_reload_goes_on(browser: Any, tmp_path: Path, weights: WeightsSnapshot):
    from selenium.webdriver.common.action_chains import ActionChains

    with opened(browser, tmp_path, weights):
        browser.execute_script("element('speed').value = '8'")
        start = learner_at(browser)
        canvas = browser.find_element("id", "canvas")
        size = canvas.size["width"]
        aim = browser.execute_script("return [toX(0), toY(0)].map(value => value - canvas.clientWidth / 2)")
        assert size > 100 and aim == [0, 0]
        ActionChains(browser).move_to_element(canvas).click_and_hold().perform()  # the middle of the scene
        wait_until(browser, "step >= 10")
        ActionChains(browser).release().perform()
        seen = learner_at(browser)
        towards = -start / np.linalg.norm(start)
        assert np.dot(seen - start, towards) > 0.95 * np.linalg.norm(seen - start) > 0.1
        wait_until(browser, "paths !== null")  # it stands where it is, and the scene goes on to its end
        assert browser.execute_script("return driving") is False
        browser.refresh()
        wait_until(browser, "driving && number === 1")
        assert browser.find_element("css selector", "#scenes tr:nth-child(2) th").text == "1"
