"""`shoal dashboard` and `shoal watch --live` over a real sweep and a real training, in Chromium and on the shell."""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import urllib.request
from contextlib import closing, contextmanager

import numpy as np
import pytest

from actors.evaluation.evaluator import record_episode
from actors.evaluation.result_table import read_table, write_table
from deploy.cli import main
from deploy.commands.dashboard import report_server
from deploy.drive import DrivenRun
from deploy.live import live_server
from deploy.report_data.sources import find_report_source
from deploy.runs.policy_lookup import find_policy
from learner.checkpoints.checkpoint import newest_valid
from learner.loop import TrainingLoop
from learner.run_folder import RunFolder
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import SweepConfig, make_cells
from learner.tracking.journal import Journal, read_rows
from learner.tracking.mlflow_run import Tracker
from learner.training.cluster import ProcessCluster
from tests.dashboards.chromium import complaints, open_chromium, wait_until
from tests.dashboards.pages.test_report_page import requested
from tests.integration.conftest import PATIENCE_S, SMALL, clean_environment
from tests.integration.test_process_run import Silent

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]
ENV_STEPS = 22_000
SWEEP = SweepConfig(
    methods=("sensor",),
    set=("eval_every_env_steps=8000", "eval_episodes=10"),
    robots=(5,),
    groups=(1, 2),
    seeds=(0,),
    env_steps=ENV_STEPS,
    episodes=30,
    extrapolation_episodes=8,
    baselines=("greedy",),
    baseline_episodes=10,
)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """The folder of a finished sweep of two setups and a baseline."""
    folder = tmp_path_factory.mktemp("sweeps") / "small"
    uri = f"sqlite:///{folder.parent / 'mlflow.db'}"
    Tracker(uri, "cells", str(folder.parent / "artifacts"))
    place = SweepLocation(folder / "cells", uri, "cells")
    tables = [run_cell(SWEEP, cell, place, lambda row: None) for cell in make_cells(SWEEP)]
    write_table(folder / "results.csv", [row for table in tables for row in read_table(table)])
    return folder


def train(folder, env_steps):
    """A training of so many env steps, as its folder would have it."""
    config = dataclasses.replace(SMALL, total_env_steps=env_steps)
    run = RunFolder(folder)
    run.save_config(config)
    with closing(Journal(run.journal, 0)) as journal:
        loop = TrainingLoop(config, ProcessCluster(config, 0), journal, run.checkpoints, Silent(), bool)
        assert loop.run()
    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training that has come half way."""
    return train(tmp_path_factory.mktemp("runs") / "r", 3_000)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with open_chromium(tmp_path_factory.mktemp("chromium")) as chromium:
        yield chromium


@contextmanager
def serving(server):
    thread = threading.Thread(target=server.serve)
    thread.start()
    yield server.url
    server.close()
    thread.join(20)


def open_report(browser, url):
    browser.get_log("performance")
    browser.get(url)
    wait_until(browser, "document.body.dataset.ready === 'yes' && data !== null")


def read(url):
    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
        return json.load(answer)


def test_the_file_holds_the_evaluated_episodes(browser, sweep, tmp_path, capsys):
    path = tmp_path / "d.html"
    assert main(["dashboard", str(sweep), "--out", str(path)]) == 0
    assert capsys.readouterr().out.strip() == str(path)
    open_report(browser, path.as_uri())
    keys = browser.execute_script("return Object.keys(episodes.samples)")
    rows = {f"{r.policy}|{r.groups}": r for r in read_table(sweep / "results.csv") if r.is_fixed}
    assert len(rows) == 4
    groups = browser.execute_script("return content.episodes.groups")
    for group in groups:
        row = rows[f"{group['policy']}|{group['played'][-2]}"]
        assert group["counts"] == {name: getattr(row, name) for name in group["counts"]}
    expected = {f"{g['key']}|{name}|0" for g in groups for name, count in g["counts"].items() if count}
    assert set(keys) == expected and len(groups) == 4
    for key in keys:
        browser.execute_async_script("load(episodes.samples[arguments[0]]).then(arguments[1])", key)
        assert browser.execute_script("return data.outcome") == key.split("|")[1]
    assert complaints(browser) == [] and requested(browser) == {path.as_uri()}


def test_a_played_episode_is_the_policys(browser, sweep, tmp_path):
    path = tmp_path / "d.html"
    main(["dashboard", str(sweep / "results.csv"), "--out", str(path)])
    open_report(browser, path.as_uri())
    shown, seed = browser.execute_script("return [episodes.shown, Number(data.setup.split(' ').pop())]")
    cell = RunFolder(sweep / "cells" / shown.split("/")[0])
    config = cell.config()
    episode = record_episode(config.env, find_policy(cell, config), seed)
    step = len(episode.position) // 2
    seen = browser.execute_script("return Array.from(positions)")
    np.testing.assert_allclose(np.reshape(seen, episode.position.shape)[step], episode.position[step], atol=0.001)


def test_a_served_report_follows_the_sweep(browser, sweep, tmp_path):
    folder = shutil.copytree(sweep, tmp_path / "growing")
    rows = read_table(folder / "results.csv")
    write_table(folder / "results.csv", [row for row in rows if row.trained_groups == 1])
    hidden = [path for path in folder.glob("cells/*5r2g*")]
    for path in hidden:
        path.rename(tmp_path / path.name)
    with serving(report_server(find_report_source(str(folder), tmp_path), 0)) as url:
        open_report(browser, url)
        rate = "document.querySelector('#success .plot').data[0].z[0]"
        wait_until(browser, f"{rate}[0] !== null && {rate}[1] === null")
        choice = browser.execute_script("return episodes.chosen.trained")
        for path in hidden:
            (tmp_path / path.name).rename(path)
        write_table(folder / "results.csv", rows)
        wait_until(browser, f"{rate}[1] !== null")
        fixed = next(r for r in rows if (r.policy, r.trained_groups, r.groups) == ("learned", 2, 2))
        assert browser.execute_script(f"return {rate}[1]") == pytest.approx(fixed.goal / fixed.episodes)
        assert browser.execute_script("return episodes.chosen.trained") == choice  # what the reader chose stays
        assert "Live" in browser.find_element("id", "status").text

        foreign = next(r for r in rows if (r.policy, r.trained_groups, r.groups) == ("learned", 1, 2))
        browser.execute_script("episodes.choose({trained: '5r×1g', played: '5r×2g'})")
        wait_until(browser, "data.setup.startsWith('5r×2g')")
        outcome, step = browser.execute_script("return [episodes.chosen.outcome, data.outcome]")
        assert outcome == step and getattr(foreign, outcome) > 0
        assert all(address.startswith(url) for address in requested(browser))
        assert complaints(browser) == []
    wait_until(browser, "element('status').textContent.startsWith('The server does not answer')")
    browser.get("about:blank")
    browser.get_log("browser")  # the requests that nobody answered


def test_curves_and_speeds_are_the_journals(sweep):
    data = {chart.key: chart for chart in find_report_source(str(sweep), sweep).contents().charts}
    journal = next(sweep.glob("cells/sensor-5r2g*/metrics.jsonl"))
    measured = [row for row in read_rows(journal) if "eval/success_rate" in row.metrics]
    low, high, line = data["curves"].views["5r×2g"].panels[0].figure["data"]
    assert line["x"] == [row.env_steps for row in measured] + [ENV_STEPS]  # and the evaluation at the end
    assert line["y"][:-1] == [row.metrics["eval/success_rate"] for row in measured]
    assert low["y"][0] == measured[0].metrics["eval/success_rate_low"] and high["y"][0] >= line["y"][0]
    assert len(data["throughput"].views[""].table.rows) == 2


def test_a_run_shows_its_curve_and_newest_policy(browser, trained, tmp_path, capsys):
    path = tmp_path / "run.html"
    assert main(["dashboard", "r", "--runs-dir", str(trained.path.parent), "--out", str(path)]) == 0
    open_report(browser, path.as_uri())
    rows = [row for row in read_rows(trained.journal) if "eval/success_rate" in row.metrics]
    drawn = browser.execute_script("return document.querySelector('#curves .plot').data[2].y")
    assert drawn == [row.metrics["eval/success_rate"] for row in rows] and rows
    counts = browser.execute_script("return content.episodes.groups[0].counts")
    assert sum(counts.values()) == 100
    updates = newest_valid(trained.checkpoints)[0].state["updates"]
    assert browser.execute_script("return content.episodes.groups[0].policy") == f"of update {updates:,}"


def test_live_plays_the_newest_policy_and_the_one_after(browser, trained, tmp_path):
    run = RunFolder(tmp_path / "r")
    shutil.copytree(trained.path, run.path)
    early = newest_valid(run.checkpoints)[0].state["updates"]
    with serving(live_server(run, run.config(), 2_000_000_000, 0)) as url:
        browser.get(url)
        wait_until(browser, f"element('status').dataset.updates === '{early}' && playing")
        said = browser.find_element("id", "status").text
        assert f"Playing the policy of update {early:,}." in said and "of 3,000 env steps" in said
        wait_until(browser, "playing && (setPlaying(false), true)")  # a pause, until the newer policy is there
        first = browser.execute_script("return data.setup")
        train(tmp_path / "later", 6_000)
        newer = newest_valid(tmp_path / "later" / "checkpoints")[0]
        newer.folder.rename(run.checkpoints / newer.folder.name)
        wait_until(browser, "element('status').textContent.includes('plays next')")
        browser.execute_script("seek(data.steps - 1); setPlaying(true)")
        wait_until(browser, f"element('status').dataset.updates === '{newer.state['updates']}'")
        assert newer.state["updates"] > early
        assert browser.execute_script("return data.setup") != first  # another seed
        assert complaints(browser) == []


def test_live_waits_for_the_first_checkpoint(browser, trained, tmp_path):
    run = RunFolder(tmp_path / "r")
    run.save_config(SMALL)
    with serving(live_server(run, SMALL, 7, 0)) as url:
        browser.get(url)
        wait_until(browser, "element('status').textContent.startsWith('The run has no checkpoint yet')")
        shutil.copytree(trained.checkpoints, run.checkpoints)
        wait_until(browser, "data !== null && playing")
        assert read(f"{url}episode.json?number=2")["setup"].endswith("seed 9")


def test_what_was_driven_is_drawn_and_what_was_not_is_refused(trained, tmp_path, capsys):
    run = RunFolder(shutil.copytree(trained.path, tmp_path / "r"))
    config = run.config()
    picture = ["watch", str(run.path), "--drive", "--format", "png", "--seed", "41"]
    assert main(picture) == 2
    assert "nobody has driven scene 41" in capsys.readouterr().err
    driven = DrivenRun(run, config.world, find_policy(run, config), 40)
    driven.begin({"number": 1})
    step, outcome = 0, "running"
    while outcome == "running":
        made = driven.move({"step": step, "x": 1, "y": 0})
        step, outcome = step + len(made["positions"]), made["outcome"]
    assert main(picture) == 0
    assert f"{step} env steps, outcome {outcome}" in capsys.readouterr().out
    assert (run.artifacts / "driven-41.png").stat().st_size > 1_000


def listen_to_ctrl_c():
    """As in a terminal: what a script starts in the background, as it may these tests, ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("command", [["dashboard", "--serve"], ["watch", "--live"], ["watch", "--drive"]])
def test_ctrl_c_ends_a_server(trained, tmp_path, command):
    arguments = [command[0], str(trained.path), command[1], "--port", "0"]
    with subprocess.Popen(
        [sys.executable, "-m", "deploy", *arguments],
        cwd=tmp_path,
        env=clean_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=listen_to_ctrl_c,
    ) as process:
        try:
            url = re.match(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
            with urllib.request.urlopen(url[0], timeout=PATIENCE_S) as answer:
                assert b"<canvas" in answer.read()
            process.send_signal(signal.SIGINT)
            out, error = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert (process.returncode, out.strip(), error) == (0, "ended", "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["dashboard", "nobody"], ["nobody", "there are no runs"]),
        (["dashboard", "missing.csv"], ["missing.csv", "results.csv"]),
        (["dashboard", "bad.csv"], ["bad.csv", "first line"]),
        (["dashboard", "bad.csv", "--serve", "--out", "x.html"], ["--serve", "--out"]),
        (["dashboard", "bad.csv", "--port", "70000"], ["--port", "65535"]),
        (["dashboard", "bad.csv", "--episodes", "-1"], ["--episodes", "negative"]),
        (["watch", "r", "--live", "--format", "mp4"], ["--live", "--format"]),
        (["watch", "nobody", "--live"], ["nobody"]),
        (["watch", "r", "--live", "--drive"], ["--live", "--drive", "one of them"]),
        (["watch", "r", "--drive", "--out", "x.html"], ["--drive", "--out", "--format"]),
    ],
)
def test_bad_input_is_refused_in_a_sentence(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error and error.count("\n") == 1
    for word in words:
        assert word in error
