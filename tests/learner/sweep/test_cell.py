"""One cell of a sweep: its results are those of its episodes, and no crash changes or duplicates them."""

import dataclasses
import shutil
import threading
import time

import mlflow
import numpy as np
import pytest

from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.evaluator import evaluate
from actors.evaluation.result_table import read_table
from actors.policy.baselines import Baseline
from actors.rollout.vector_env import env_shape
from actors.storage.fragment_writer import sync_all
from learner.checkpoints.checkpoint import finished_names
from learner.checkpoints.manifest import CheckpointError
from learner.export.saved_policy import read_saved_policy
from learner.run_folder import RunFolder
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import Cell, SweepConfig, cell_hash
from learner.tracking.mlflow_run import Tracker
from sim_core.outcomes import ENDED, Outcome

pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

SWEEP = SweepConfig(robots=(3, 4), groups=(1, 2), seeds=(3,), episodes=40, extrapolation_episodes=10, first_seed=77)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mlflow")
    uri = f"sqlite:///{folder / 'mlflow.db'}"
    Tracker(uri, "cells", str(folder / "artifacts"))
    return uri


@pytest.fixture
def cell(small_run):
    config = dataclasses.replace(
        small_run,
        total_env_steps=4_000,
        eval_every_env_steps=1_000,
        eval_episodes=4,
        log_every_env_steps=500,
        checkpoint_every_env_steps=1_000,
        final_eval_episodes=SWEEP.episodes,
        final_eval_first_seed=SWEEP.first_seed,
    )
    return Cell(f"cell-{cell_hash(config)}", config)


def runs_of(uri, cell):
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("cells").experiment_id
    return client, client.search_runs([experiment], f"tags.cell = '{cell.key}'")


class Crash(Exception):
    pass


def crashing_at(env_steps):
    def on_row(row):
        if row.env_steps >= env_steps:
            raise Crash

    return on_row


def test_a_cells_table_counts_its_stored_episodes(store, cell, tmp_path):
    location = SweepLocation(tmp_path, store, "cells")
    rows = read_table(run_cell(SWEEP, cell, location, lambda row: None))
    assert {(row.robots, row.groups): row.episodes for row in rows} == {(3, 2): 40, (3, 1): 10, (4, 1): 10, (4, 2): 10}
    folder = RunFolder(tmp_path / cell.key)
    weights = read_saved_policy(folder.policy, cell.config, env_shape(cell.config.env))
    for row in rows:
        stored = load_evaluation(folder.path / "evaluations" / f"{row.robots}r{row.groups}g.zarr")
        world = dataclasses.replace(cell.config.world, robots=row.robots, groups=row.groups)
        assert stored.spec.world == world and stored.updates == weights.version
        np.testing.assert_array_equal(stored.seed, np.arange(77, 77 + row.episodes))
        played = evaluate(stored.spec, weights, stored.seed.tolist())
        np.testing.assert_array_equal(stored.stats.outcome, played.outcome)
        assert [row.count(kind) for kind in ENDED] == [int((played.outcome == kind).sum()) for kind in ENDED]
        assert row.mean_length_steps == pytest.approx(played.length_steps.mean(), abs=0.005)
        assert (row.trained_robots, row.trained_groups, row.seed, row.config) == (3, 2, 3, cell_hash(cell.config))
    client, runs = runs_of(store, cell)
    fixed = next(row for row in rows if row.is_fixed)
    assert len(runs) == 1 and runs[0].info.status == "FINISHED"
    assert runs[0].data.metrics["final/success_rate"] == fixed.count(Outcome.GOAL) / 40
    assert runs[0].data.tags["preset"] == "thesis" and runs[0].data.tags["setup"] == "3r×2g"
    artifacts = {item.path for item in client.list_artifacts(runs[0].info.run_id)}
    assert artifacts == {"results.csv", "policy.safetensors"}
    assert not folder.checkpoints.exists()


def test_a_baselines_table_counts_its_episodes(store, cell, tmp_path):
    cell = Cell("greedy-cell", cell.config, "greedy")
    rows = read_table(run_cell(SWEEP, cell, SweepLocation(tmp_path, store, "cells"), crashing_at(0)))
    played = evaluate(cell.config.env, Baseline.GREEDY, list(range(77, 77 + 40)))
    assert [(row.policy, row.episodes, row.is_fixed) for row in rows] == [("greedy", 40, True)]
    assert [rows[0].count(kind) for kind in ENDED] == [int((played.outcome == kind).sum()) for kind in ENDED]
    runs = runs_of(store, cell)[1]
    assert [run.info.status for run in runs] == ["FINISHED"]
    assert runs[0].info.run_name == "greedy: sensor 3r×2g" and runs[0].data.tags["policy"] == "greedy"
    assert runs[0].data.metrics["final/success_rate"] == rows[0].goal / 40


def test_a_failed_baseline_is_evaluated_again_in_the_same_mlflow_run(store, cell, tmp_path, monkeypatch):
    cell = Cell("greedy-again", cell.config, "greedy")
    location = SweepLocation(tmp_path / "sweep" / "cells", store, "cells")

    def fail(*arguments):
        raise Crash

    with monkeypatch.context() as patch:
        patch.setattr("learner.sweep.cell._log_table", fail)  # after MLflow has the results
        with pytest.raises(Crash):
            run_cell(SWEEP, cell, location, id)
    assert [run.info.status for run in runs_of(store, cell)[1]] == ["FAILED"]
    run_cell(SWEEP, cell, location, id)
    client, runs = runs_of(store, cell)
    assert [run.info.status for run in runs] == ["FINISHED"]
    assert len(client.get_metric_history(runs[0].info.run_id, "final/success_rate")) == 1


def test_two_sweeps_in_one_experiment_have_runs_of_their_own(store, cell, tmp_path):
    cell = Cell("greedy-twice", cell.config, "greedy")
    for sweep in ("one", "two", "one"):
        shutil.rmtree(tmp_path / sweep, ignore_errors=True)
        run_cell(SWEEP, cell, SweepLocation(tmp_path / sweep / "cells", store, "cells"), id)
    assert sorted(run.data.tags["sweep"] for run in runs_of(store, cell)[1]) == ["one", "two"]


def test_a_finished_cell_evaluates_its_policy_again_where_more_is_wanted(store, cell, tmp_path):
    cell = cell._replace(key=f"{cell.key}-more")
    location = SweepLocation(tmp_path, store, "cells")
    small = dataclasses.replace(SWEEP, robots=(3,), groups=(2,))
    fixed = read_table(run_cell(small, cell, location, lambda row: None))
    assert len(fixed) == 1
    rows = read_table(run_cell(SWEEP, cell, location, crashing_at(0)))  # nothing is trained
    other = cell._replace(key=f"{cell.key}-whole")
    assert rows == read_table(run_cell(SWEEP, other, location, lambda row: None)) and fixed[0] in rows
    assert [run.info.status for run in runs_of(store, cell)[1]] == ["FINISHED"]


def test_a_training_too_short_for_a_row_of_metrics_finishes(store, cell, tmp_path):
    config = dataclasses.replace(cell.config, log_every_env_steps=100_000, eval_every_env_steps=100_000)
    short = Cell(f"{cell.key}-short", config)
    assert len(read_table(run_cell(SWEEP, short, SweepLocation(tmp_path, store, "cells"), crashing_at(0)))) == 4
    runs = runs_of(store, short)[1]
    assert [run.info.status for run in runs] == ["FINISHED"] and "final/success_rate" in runs[0].data.metrics


def test_a_finished_cell_is_not_run_again(store, cell, tmp_path):
    location = SweepLocation(tmp_path, store, "cells")
    table = run_cell(SWEEP, cell, location, lambda row: None)
    before = table.stat().st_mtime_ns
    assert run_cell(SWEEP, cell, location, crashing_at(0)) == table
    assert table.stat().st_mtime_ns == before


@pytest.mark.parametrize("crashes", [[0], [1_500], [2_600, 3_500]])
def test_a_crashed_cell_has_the_results_of_an_undisturbed_one(store, cell, tmp_path, crashes):
    key = f"{cell.key}-{len(crashes)}-{crashes[0]}"  # each case has an MLflow run of its own
    cell = cell._replace(key=key)
    whole = read_table(run_cell(SWEEP, cell._replace(key=f"{key}-whole"), SweepLocation(tmp_path, store, "cells"), id))
    location = SweepLocation(tmp_path, store, "cells")
    for env_steps in crashes:
        with pytest.raises(Crash):
            run_cell(SWEEP, cell, location, crashing_at(env_steps))
        assert not (tmp_path / key / "results.csv").exists()
    assert read_table(run_cell(SWEEP, cell, location, id)) == whole
    client, runs = runs_of(store, cell)
    assert len(runs) == 1 and runs[0].info.status == "FINISHED"
    history = client.get_metric_history(runs[0].info.run_id, "eval/success_rate")
    assert len({metric.step for metric in history}) == len(history) >= 3


def history_of(store, cell, key):
    client, runs = runs_of(store, cell)
    assert len(runs) == 1 and runs[0].info.status == "FINISHED"
    return [metric.step for metric in client.get_metric_history(runs[0].info.run_id, key)]


def test_a_cell_whose_checkpoints_are_all_damaged_starts_afresh_and_logs_nothing_twice(
    store, cell, tmp_path, monkeypatch
):
    cell = cell._replace(key=f"{cell.key}-damaged")
    location = SweepLocation(tmp_path, store, "cells")

    def crash(*args):
        raise Crash

    monkeypatch.setattr("learner.sweep.cell.save_policy", crash)  # once MLflow has the whole training
    with pytest.raises(Crash):
        run_cell(SWEEP, cell, location, id)
    monkeypatch.undo()
    logged = mlflow.MlflowClient(store).get_metric_history(runs_of(store, cell)[1][0].info.run_id, "train/loss")
    assert logged, "rows had reached MLflow before the crash"
    checkpoints = list((tmp_path / cell.key / "checkpoints").glob("step-*/state.json"))
    assert checkpoints
    for state in checkpoints:
        state.write_text("{}")
    run_cell(SWEEP, cell, location, id)
    for key, count in (("train/loss", 3), ("eval/success_rate", 3), ("final/success_rate", 1)):
        steps = history_of(store, cell, key)
        assert len(steps) == len(set(steps)) >= count


def test_a_checkpoint_with_another_config_is_refused_and_kept(store, cell, tmp_path):
    cell = cell._replace(key=f"{cell.key}-other")
    location = SweepLocation(tmp_path, store, "cells")
    checkpoints = tmp_path / cell.key / "checkpoints"

    def crash_after_a_checkpoint(row):
        if row.env_steps >= 2_600:
            while not finished_names(checkpoints):  # pytest's timeout ends the wait
                time.sleep(0.01)
            raise Crash

    with pytest.raises(Crash):
        run_cell(SWEEP, cell, location, crash_after_a_checkpoint)
    kept = sorted(checkpoints.iterdir())
    other = cell._replace(config=dataclasses.replace(cell.config, learning_rate=0.5))
    with pytest.raises(CheckpointError, match="learning_rate is 0.5 instead of 0.001"):
        run_cell(SWEEP, other._replace(key=cell.key), location, id)
    assert sorted(checkpoints.iterdir()) == kept


def test_nothing_is_written_after_a_crash(store, cell, tmp_path, monkeypatch):
    cell = cell._replace(key=f"{cell.key}-writes")

    def slow_sync(path):
        time.sleep(0.5)
        sync_all(path)

    monkeypatch.setattr("actors.storage.fragment_writer.sync_all", slow_sync)
    with pytest.raises(Crash):
        run_cell(SWEEP, cell, SweepLocation(tmp_path, store, "cells"), crashing_at(1_500))  # checkpoint at 1,000
    writers = ("shoal-fragment", "shoal-checkpoint")
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith(writers)]
    checkpoints = tmp_path / cell.key / "checkpoints"
    assert [path.name for path in checkpoints.iterdir()] == finished_names(checkpoints)


def test_a_cell_whose_folder_is_gone_keeps_its_mlflow_run(store, cell, tmp_path):
    cell = cell._replace(key=f"{cell.key}-gone")
    location = SweepLocation(tmp_path, store, "cells")
    with pytest.raises(Crash):
        run_cell(SWEEP, cell, location, crashing_at(2_000))
    shutil.rmtree(tmp_path / cell.key)
    run_cell(SWEEP, cell, location, id)
    assert len(runs_of(store, cell)[1]) == 1
