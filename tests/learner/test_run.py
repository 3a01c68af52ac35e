"""A session of a run: its attempts, what it logs, and the status with which it ends the MLflow run."""

import dataclasses
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from actors.rollout.vector_env import env_shape
from actors.service.fault_policy import Component, ComponentFailed, ComponentKind, Fault, RunFailed
from actors.service.messages import EpisodeStats
from actors.service.rpc import LocalCalls
from learner.cluster_options import ClusterOptions
from learner.run import RunSession, Step
from learner.run_end import EndState, RunEnd
from learner.run_folder import RunFolder
from learner.tracking.tracked_run import TrackingError
from learner.training.cluster import ProcessCluster
from learner.training.recovery import RunLost
from learner.update.learner import Learner
from sim_core.outcomes import Outcome

LOST = ComponentFailed(Component(ComponentKind.LEARNER), 4, Fault.DIED, "simulated")
COMPASS = Path(__file__).parents[2] / "deploy" / "examples" / "compass.py"
EPISODES = EpisodeStats(np.full(2, Outcome.GOAL), np.ones(2, np.int32), np.ones(2))


def no_steps(result, rows):
    return []


class FakeTracker:
    """Remembers what is logged; implements the methods of Tracker that a session calls."""

    uri, started_ms, retry_timeout_s = "sqlite:///mlflow.db", 1_000, 0.0

    def __init__(self):
        self.results, self.status, self.begun = [], None, None

    def push(self, rows):
        pass

    def begin_policy(self, weights, config, shape):
        self.begun = weights.version

    def log_results(self, metrics, time_ms):
        self.results.append((metrics["success_rate"], time_ms))

    def end(self, status):
        self.status = status


@pytest.fixture
def user_method(tmp_path):
    """A method in a file of a user's own."""
    path = tmp_path / "mine.py"
    path.write_text(COMPASS.read_text())
    return f"{path}:Compass"


class Messages(list):
    """A display that remembers its messages."""

    def row(self, row):
        pass

    def message(self, text):
        self.append(text)


@pytest.fixture
def session(tmp_path, small_run, monkeypatch):
    """A session whose attempts end as in `session.outcomes`: True (finished), False (stopped), or an exception."""
    outcomes, incarnations = [], []
    config = dataclasses.replace(small_run, final_eval_episodes=2)
    weights = Learner(config, env_shape(config.env)).weights(0.0)._replace(version=7)

    class FakeLoop:
        """Ends as the next of `outcomes` says."""

        env_steps, updates, saved = 2_000, 50, None

        def __init__(self, *args):
            pass

        def run(self):
            outcome = outcomes.pop(0)
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome

        def newest_weights(self):
            return weights

        def lost(self, failure):
            return RunLost(failure, failure.incarnation)

    def open_cluster(config, incarnation, place):
        incarnations.append(incarnation)
        return ProcessCluster(config, incarnation)

    monkeypatch.setattr("learner.run.TrainingLoop", FakeLoop)
    monkeypatch.setattr("learner.run.open_cluster", open_cluster)
    monkeypatch.setattr("learner.run.evaluate_in_parallel", lambda *arguments: EPISODES)
    tracker, display = FakeTracker(), Messages()
    made = RunSession(RunFolder(tmp_path / "r"), config, tracker, display, ClusterOptions())
    return SimpleNamespace(
        execute=made.execute, outcomes=outcomes, incarnations=incarnations, tracker=tracker, display=display
    )


def test_a_finished_run_is_evaluated_and_logged(session):
    session.outcomes.append(True)
    finished = []

    def steps(result, rows):
        return [Step("the artifacts", lambda: finished.append((result, rows)))]

    result = session.execute(None, steps)
    assert (result.env_steps, result.updates, result.stopped_by) == (2_000, 50, None)
    assert result.evaluation.episodes == 2 and result.is_known and result.weights.version == 7
    assert all(map(np.array_equal, result.episodes, EPISODES)) and len(finished) == 1 and not finished[0][1]
    assert session.tracker.results == [(1.0, 3_000)] and session.tracker.status == "FINISHED"
    assert session.tracker.begun == 7


def test_a_lost_learner_leads_to_another_attempt(session):
    session.outcomes += [LOST, True]
    result = session.execute(None, no_steps)
    assert result.evaluation is not None and session.tracker.status == "FINISHED"
    assert session.incarnations == [0, 5], "above every incarnation of the first attempt"
    assert "going on from the start" in session.display, "there is no checkpoint"


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), "KILLED"), (ValueError("a bug"), "FAILED")])
def test_an_error_ends_the_mlflow_run_with_its_status(session, error, status):
    session.outcomes.append(error)
    with pytest.raises(type(error)):
        session.execute(None, no_steps)
    assert session.tracker.status == status and not session.tracker.results


def test_a_store_that_fails_at_the_end_is_reported_and_hides_no_result(session, monkeypatch):
    def fail(status):
        raise TrackingError("away")

    session.outcomes.append(True)
    monkeypatch.setattr(session.tracker, "end", fail)
    result = session.execute(None, no_steps)
    assert result.evaluation is not None and not result.is_known
    assert "MLflow does not know that the run is FINISHED: away" in session.display


def test_artifacts_that_mlflow_refuses_fail_the_run_which_can_be_resumed(session):
    def fail():
        raise TrackingError("away")

    session.outcomes.append(True)
    with pytest.raises(RunFailed, match=r"its end lacks the artifacts \(away\); `shoal resume .*r` makes it"):
        session.execute(None, lambda result, rows: [Step("the artifacts", fail)])
    assert session.tracker.status == "FAILED"
    assert session.execute(None, no_steps).evaluation is not None and session.incarnations == [0], "nothing is trained"
    assert session.tracker.status == "FINISHED" and len(session.tracker.results) == 1


@pytest.mark.parametrize(("episodes", "method", "opens"), [(2, "sensor", 0), (8_000, "sensor", 1), (2, "user", 1)])
def test_a_session_plays_a_short_evaluation_of_ours_itself(
    episodes, method, opens, tmp_path, small_run, monkeypatch, user_method
):
    opened, called = [], []

    @contextmanager
    def open_calls(config, options):
        opened.append(config)
        yield LocalCalls(), 2

    def play(calls, *arguments):
        called.append(calls)
        return EpisodeStats(*(np.resize(field, episodes if len(field) else 0) for field in EPISODES))

    monkeypatch.setattr("learner.run.open_calls", open_calls)
    monkeypatch.setattr("learner.run.evaluate_in_parallel", play)
    world = small_run.world if method == "sensor" else dataclasses.replace(small_run.world, method=user_method)
    config = dataclasses.replace(small_run, engine="ray", final_eval_episodes=episodes, world=world)
    weights = Learner(config, env_shape(config.env)).weights(0.0)
    folder = RunFolder(tmp_path / "r")
    folder.path.mkdir()
    folder.journal.touch()
    RunEnd.begin(folder.end, config, EndState(config.total_env_steps, 0, 0, None, []), weights)
    tracker = FakeTracker()
    RunSession(folder, config, tracker, Messages(), ClusterOptions()).execute(None, no_steps)
    assert len(opened) == opens and len(called) == 1 and tracker.begun == 0
