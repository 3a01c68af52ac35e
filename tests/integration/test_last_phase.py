"""The end of a run can be cut anywhere, and `shoal resume` makes the rest of it without any env step."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import mlflow
import pytest

from actors.evaluation.trajectory import load_episodes
from actors.rollout.node import RolloutNode
from deploy.cli import main
from learner.run_end import RunEnd
from tests.dying import Killed, Places
from tests.integration.conftest import SMALL, flags

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query
SHORT = dataclasses.replace(SMALL, total_env_steps=2_048, eval_every_env_steps=1_024, log_every_env_steps=512)


def train(folder: Path, *more: str) -> None:
    """Trains run `r`; MLflow keeps a tracking URI for all of this process."""
    place = ["--runs-dir", str(folder), "--name", "r", "--tracking-uri", f"sqlite:///{folder}/mlflow.db"]
    main(["train", *place, *flags(SHORT), *more])


def resume(folder: Path) -> int:
    return main(["resume", "r", "--runs-dir", str(folder)])


def assert_whole(folder: Path, expected: dict[str, float], rows: str) -> None:
    """The run is as one that nothing cut: its status, results, artifacts and policy are there, each once."""
    client = mlflow.MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    assert run.info.status == "FINISHED"
    assert {name: value for name, value in run.data.metrics.items() if name.startswith("final/")} == expected
    for name in ("final/return", "eval/return", "train/epsilon"):
        history = [(metric.step, metric.timestamp) for metric in client.get_metric_history(run.info.run_id, name)]
        assert len(history) == len(set(history)) >= 1
    assert (folder / "r" / "metrics.jsonl").read_text() == rows, "no env step was made again"
    (version,) = client.search_model_versions("name = 'sensor-3r-2g'")
    assert client.get_model_version_by_alias("sensor-3r-2g", "best").version == version.version
    models = client.search_logged_models([run.info.experiment_id])
    assert [(model.model_id, str(model.status)) for model in models] == [(version.source.split("/")[1], "READY")]
    stored = {item.path for item in client.list_artifacts(run.info.run_id)}
    assert stored == {"config.json", "learning_curve.png", "episode.html", "episode.zarr"}
    copy = Path(run.info.artifact_uri)
    assert (copy / "learning_curve.png").read_bytes()[-8:-4] == b"IEND"
    assert len(load_episodes(copy / "episode.zarr")[0]) == 1
    assert not list(folder.rglob("*.part"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(metrics of the result) of a run that nothing cut."""
    folder = tmp_path_factory.mktemp("whole")
    train(folder)
    client = mlflow.MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return {name: value for name, value in run.data.metrics.items() if name.startswith("final/")}


def die(*arguments):
    raise Killed


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """The folder of a run that was killed when it had written its last checkpoint; nobody may make an env step."""
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(RunEnd, "begin", die)
        patch.setattr("learner.tracking.mlflow_run.Tracker.end", die)
        train(tmp_path)
    monkeypatch.setattr(RolloutNode, "collect", die)
    monkeypatch.setattr("learner.run.LAST_FLUSH_S", 0.5)
    return tmp_path


def kill_until_done(places: Places, work: Callable[[], object]) -> None:
    """Has processes do the work, each killed at the first place where none was; the last one lives."""
    while True:
        try:
            with places.of_a_process():
                work()
            return
        except Killed:
            pass


def test_each_session_dies_at_a_later_place_of_the_end(trained, whole, capsys):
    rows, places = (trained / "r" / "metrics.jsonl").read_text(), Places(trained)
    kill_until_done(places, lambda: resume(trained))
    assert len(places.deadly) >= 30
    assert_whole(trained, whole, rows)
