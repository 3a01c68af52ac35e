"""A run in MLflow, with a real store in a file."""

import dataclasses
import math
import os
import time

import mlflow
import numpy as np
import pytest
import torch

from actors.policy.policy import Policy
from actors.rollout.vector_env import env_shape
from learner.config import RunConfig, config_hash, flat_params
from learner.tracking.journal import Row
from learner.tracking.mlflow_run import Tracker, check_reachable, git_commit, tracking_at
from learner.tracking.redaction import VARIABLE
from learner.update.learner import Learner
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig

# MLflow's own tables use an option that SQLAlchemy 2.1 is going to drop.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """(tracking URI, artifact folder) of one database for all tests: making it takes seconds."""
    folder = tmp_path_factory.mktemp("mlflow")
    return f"sqlite:///{folder / 'mlflow.db'}", str(folder / "artifacts")


@pytest.fixture
def tracker(store, small_run):
    """A started run."""
    made = Tracker(store[0], "tests", store[1])
    made.start(small_run, {"cell": "one"})
    return made


def run_of(tracker):
    return mlflow.MlflowClient(tracker.uri).get_run(tracker.run_id)


def history(tracker, key):
    metrics = mlflow.MlflowClient(tracker.uri).get_metric_history(tracker.run_id, key)
    return [(metric.step, metric.timestamp, metric.value) for metric in metrics]


def test_params_are_complete_and_flat(tracker, small_run):
    fields = {field.name for kind in (RunConfig, WorldConfig) for field in dataclasses.fields(kind)} - {"world"}
    params = run_of(tracker).data.params
    assert params.keys() == fields
    assert (params["robots"], params["hidden_sizes"], params["engine"]) == ("3", "(8,)", "process")
    assert len(flat_params(small_run)) == len(dataclasses.fields(RunConfig)) - 1 + len(dataclasses.fields(WorldConfig))


def test_tags_hold_what_a_user_filters_by(tracker, small_run, store):
    tags = run_of(tracker).data.tags
    expected = {"method": "sensor", "robots": "3", "groups": "2", "seed": "3", "engine": "process"}
    assert expected.items() <= tags.items()
    assert tags["config_hash"] == config_hash(small_run) and tags["mlflow.source.git.commit"]
    assert tags["mlflow.runName"] == "sensor 3r×2g s3" and run_of(tracker).info.status == "RUNNING"
    found = mlflow.MlflowClient(store[0]).search_runs(
        [run_of(tracker).info.experiment_id], "tags.robots = '3' and tags.method = 'sensor' and params.sectors = '4'"
    )
    assert tracker.run_id in [run.info.run_id for run in found]


def test_rows_keep_their_step_and_time(tracker):
    tracker.push([Row(100, 1_700_000_000_001, {"a/b": 0.5, "c": 1.0}), Row(200, 1_700_000_000_002, {"a/b": 0.25})])
    assert history(tracker, "a/b") == [(100, 1_700_000_000_001, 0.5), (200, 1_700_000_000_002, 0.25)]
    assert history(tracker, "c") == [(100, 1_700_000_000_001, 1.0)]


def test_rows_that_are_pushed_twice_are_stored_once(tracker):
    rows = [Row(100 * i, 1_700_000_000_000 + i, {"a": float(i), "b": -1.0}) for i in range(6)]
    tracker.push(rows[:4])
    tracker.push(rows[2:])
    assert history(tracker, "a") == [(row.env_steps, row.time_ms, row.metrics["a"]) for row in rows]
    assert len(history(tracker, "b")) == 6


def test_many_metrics_go_in_several_requests(tracker):
    tracker.push([Row(i, 1_700_000_000_000 + i, {"a": float(i), "b": 0.0}) for i in range(1100)])
    assert [step for step, _, _ in history(tracker, "a")] == list(range(1100))
    tracker.push([])


def test_values_that_are_not_finite_are_left_out(tracker):
    tracker.push([Row(1, 1_700_000_000_000, {"a": math.nan, "b": math.inf, "c": 2.0})])
    assert run_of(tracker).data.metrics == {"c": 2.0}


def test_accounts_stay_in_the_journal(tracker):
    tracker.push([Row(1, 1_700_000_000_000, {"train/loss": 1.0, "account/updates": 8.0})])
    assert run_of(tracker).data.metrics.keys() == {"train/loss"}


def test_results_are_logged_at_step_0(tracker):
    tracker.log_results({"success_rate": 0.75}, 1_700_000_000_000)
    assert history(tracker, "final/success_rate") == [(0, 1_700_000_000_000, 0.75)]


def test_a_killed_run_is_continued_as_the_same_run(tracker, store):
    tracker.push([Row(1, 1_700_000_000_000, {"a": 1.0})])
    tracker.end("KILLED")
    assert run_of(tracker).info.status == "KILLED"
    for attempts in ("2", "3"):
        later = Tracker(store[0], "tests", store[1])
        later.resume(tracker.run_id)
        assert later.run_id == tracker.run_id
        info, tags = run_of(later).info, run_of(later).data.tags
        assert (info.status, tags["attempts"]) == ("RUNNING", attempts)
    later.push([Row(2, 1_700_000_000_001, {"a": 2.0})])
    later.end("FINISHED")
    assert [step for step, _, _ in history(tracker, "a")] == [1, 2]
    assert run_of(tracker).info.status == "FINISHED" and run_of(tracker).info.end_time


def test_an_unknown_run_cannot_be_continued(store):
    made = Tracker(store[0], "tests", store[1])
    with pytest.raises(ConfigError, match="does not know run 0123"):
        made.resume("0123456789abcdef0123456789abcdef")
    assert made.run_id == ""


def test_a_deleted_experiment_or_run_is_refused_with_how_to_restore_it(store, small_run):
    client = mlflow.MlflowClient(store[0])
    tracker = Tracker(store[0], "deleted", store[1])
    tracker.start(small_run)
    later = Tracker(store[0], None, None)
    client.delete_run(tracker.run_id)
    with pytest.raises(
        ConfigError, match=f"the run is deleted in .*`{VARIABLE}=.* runs restore --run-id {tracker.run_id}"
    ):
        later.resume(tracker.run_id)
    client.restore_run(tracker.run_id)
    later.resume(tracker.run_id)
    client.delete_experiment(tracker._experiment_id)
    for call in (lambda: Tracker(store[0], "deleted", store[1]), lambda: later.resume(tracker.run_id)):
        with pytest.raises(
            ConfigError, match=f"experiment 'deleted' is deleted.*restore -x {tracker._experiment_id}.*--exp"
        ):
            call()
    client.restore_experiment(tracker._experiment_id)
    later.resume(tracker.run_id)


def test_a_resumed_run_makes_no_experiment(tracker, store):
    client = mlflow.MlflowClient(store[0])
    client.rename_experiment(tracker._experiment_id, "renamed")
    later = Tracker(store[0], None, None)
    later.resume(tracker.run_id)
    assert later._experiment_id == tracker._experiment_id and client.get_experiment_by_name("tests") is None
    client.rename_experiment(tracker._experiment_id, "tests")


def test_an_experiment_is_made_once(store):
    first, second = Tracker(store[0], "twice", store[1]), Tracker(store[0], "twice", None)
    assert first._experiment_id == second._experiment_id
    experiment = mlflow.MlflowClient(store[0]).get_experiment(first._experiment_id)
    assert experiment.name == "twice" and "artifacts" in experiment.artifact_location


def test_files_and_folders_become_artifacts(tracker, tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "curve.png").write_bytes(b"png")
    (tmp_path / "report.html").write_text("<html>")
    tracker.log_artifact(tmp_path / "figures")
    tracker.log_artifact(tmp_path / "report.html")
    client = mlflow.MlflowClient(tracker.uri)
    assert sorted(file.path for file in client.list_artifacts(tracker.run_id)) == ["figures", "report.html"]
    assert [file.path for file in client.list_artifacts(tracker.run_id, "figures")] == ["figures/curve.png"]
    tracker.attach(tracker.run_id, tmp_path / "report.html", "stress/r+greedy")
    found = client.list_artifacts(tracker.run_id, "stress/r+greedy")
    assert [file.path for file in found] == ["stress/r+greedy/report.html"]


@pytest.fixture
def policy(small_run):
    shape = env_shape(small_run.env)
    return Learner(small_run, shape).weights(0.0), shape


def test_the_logged_policy_gives_the_same_values(tracker, policy, small_run):
    weights, shape = policy
    tracker.log_policy(weights, small_run, shape, 0.5)
    observation = np.random.default_rng(0).integers(-5, 6, (7, shape.observation_size)).astype(np.float32)
    model_uri = f"runs:/{tracker.run_id}/policy"
    with torch.no_grad(), tracking_at(tracker.uri):
        values = mlflow.pytorch.load_model(model_uri)(torch.from_numpy(observation)).numpy()
        info = mlflow.models.get_model_info(model_uri)
    np.testing.assert_allclose(values, Policy(weights).values(observation), rtol=1e-5, atol=1e-6)
    assert info.signature.inputs.inputs[0].shape == (-1, shape.observation_size)
    assert info.signature.outputs.inputs[0].shape == (-1, shape.num_actions)
    assert mlflow.active_run() is None


def test_the_registry_has_one_version_a_run_and_an_alias_for_the_best(store, policy, small_run):
    weights, shape = policy
    config = dataclasses.replace(small_run, world=dataclasses.replace(small_run.world, robots=4, groups=3))
    runs = {}
    for score in (0.5, 0.75, 0.25, 0.75):
        tracker = Tracker(store[0], "registry", store[1])
        tracker.start(config)
        for _ in range(2):  # as if the server had failed after the first call
            tracker.log_policy(weights, config, shape, score)
        runs[tracker.run_id] = score
    client = mlflow.MlflowClient(store[0])
    versions = client.search_model_versions("name = 'sensor-4r-3g'")
    assert {version.run_id: float(version.tags["score"]) for version in versions} == runs and len(versions) == 4
    best = client.get_model_version_by_alias("sensor-4r-3g", "best")
    assert best.run_id == list(runs)[1]
    with tracking_at(store[0]):
        model = mlflow.pytorch.load_model("models:/sensor-4r-3g@best")
    example = np.ones((1, shape.observation_size), np.float32)
    with torch.no_grad():
        values = model(torch.from_numpy(example)).numpy()
    np.testing.assert_allclose(values, Policy(weights).values(example), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("own", [None, "sqlite:///own.db"])
def test_the_processs_own_store_is_left_alone(tracker, policy, small_run, tmp_path, monkeypatch, own):
    monkeypatch.chdir(tmp_path)
    if own is None:
        monkeypatch.delenv(VARIABLE, raising=False)
    else:
        monkeypatch.setenv(VARIABLE, own)
    weights, shape = policy
    for _ in range(2):  # the second finds the policy logged, as a resumed end does
        tracker.log_policy(weights, small_run, shape, 0.5)
        assert os.environ.get(VARIABLE) == own and mlflow.is_tracking_uri_set() == (own is not None)
    assert not list(tmp_path.iterdir()), "the registry looks for the model in the run's store"


def test_the_episodes_of_training_and_evaluation_are_datasets(store, small_run):
    def logged(config):
        tracker = Tracker(store[0], "datasets", store[1])
        tracker.start(config)
        tracker.log_inputs(config)  # as a resumed cell of a sweep does
        inputs = run_of(tracker).inputs.dataset_inputs
        return {entry.tags[0].value: (entry.dataset.name, entry.dataset.digest) for entry in inputs}

    first, other_seed = logged(small_run), logged(dataclasses.replace(small_run, seed=4))
    assert first.keys() == {"training", "evaluation"} and {name for name, _ in first.values()} == {"sensor-3r-2g"}
    assert first["evaluation"] == other_seed["evaluation"] and first["training"] != other_seed["training"]
    slower = dataclasses.replace(small_run, world=dataclasses.replace(small_run.world, max_speed_m_s=0.5))
    assert logged(slower)["evaluation"] != first["evaluation"]


@pytest.mark.parametrize("uri", ["http://127.0.0.1:9", "https://127.0.0.1:9", "http://no-such-host.invalid"])
def test_a_server_that_does_not_answer_is_refused_at_once(uri):
    start_s = time.monotonic()
    with pytest.raises(ConfigError, match="no MLflow server answers.*mlflow server"):
        Tracker(uri, "tests", None)
    assert time.monotonic() - start_s < 10


def test_local_stores_need_no_server(tmp_path):
    for uri in (f"sqlite:///{tmp_path / 'x.db'}", str(tmp_path), f"file://{tmp_path}"):
        check_reachable(uri)


@pytest.mark.parametrize("uri", ["sqlite:///{}/a-file/mlflow.db", "sqlite:///{}/a-file", "nonsense://x", "databse:x"])
def test_a_store_that_cannot_be_opened_is_refused(uri, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a-file").write_text("no database")
    with pytest.raises(ConfigError, match="--tracking-uri"):
        Tracker(uri.format(tmp_path), "tests", None)


@pytest.mark.parametrize(
    "uri",
    [
        "http://[",
        "http://host:99999999",
        "http://me:s3cret@127.0.0.1:1",
        "https://s3cret@127.0.0.1:1",
        "postgresql://me:s3cret@127.0.0.1:1/x",
        "mysql+pymysql://me:s3cret@127.0.0.1:1/x",
        "nosuch://me:s3cret@x",
        "sqlite:////proc/nothing/x.db",
        "$(touch touched);`touch touched`",
    ],
)
def test_an_unusable_store_is_refused_without_showing_its_password(uri, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as caught:
        Tracker(uri, "tests", None)
    shown = str(caught.value) + "".join(capfd.readouterr())
    assert "s3cret" not in shown and "\n" not in str(caught.value)
    assert not (tmp_path / "touched").exists()


def test_no_secret_of_the_environment_reaches_a_run(store, small_run, monkeypatch):
    for name in ("AWS_SECRET_ACCESS_KEY", "MLFLOW_TRACKING_PASSWORD", "MLFLOW_TRACKING_TOKEN", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, "s3cret-value")
    tracker = Tracker(store[0], "tests", store[1])
    tracker.start(small_run, {"cell": "secrets"})
    data = run_of(tracker).data
    assert "s3cret-value" not in f"{data.params} {data.tags} {data.metrics}"


def test_a_checkout_without_git_has_an_unknown_commit(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert git_commit() == "unknown"
