"""A session of a run: its attempts, what it logs, and the status with which it ends the MLflow run."""

from types import SimpleNamespace

import numpy as np
import pytest
from requests import ConnectionError as NoConnection

from actors.policy.policy import WeightsSnapshot
from actors.service.fault_policy import Component, ComponentFailed, ComponentKind, Fault
from actors.service.messages import EpisodeStats
from learner.cluster_options import ClusterOptions
from learner.run import RunSession
from learner.run_folder import RunFolder
from learner.training.recovery import RunLost
from sim_core.outcomes import Outcome

LOST = ComponentFailed(Component(ComponentKind.LEARNER), 4, Fault.DIED, "simulated")
EPISODES = EpisodeStats(np.full(2, Outcome.GOAL), np.ones(2, np.int32), np.ones(2))


class FakeTracker:
    """Remembers what is logged; implements the methods of Tracker that a session calls."""

    uri, started_ms, retry_timeout_s = "sqlite:///mlflow.db", 1_000, 0.0

    def __init__(self):
        self.results, self.status = [], None

    def push(self, rows):
        pass

    def log_results(self, metrics, time_ms):
        self.results.append((metrics["success_rate"], time_ms))

    def end(self, status):
        self.status = status


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
            return WeightsSnapshot(7, 0.0, ())

        def lost(self, failure):
            return RunLost(failure, failure.incarnation)

    def open_cluster(config, incarnation, place):
        incarnations.append(incarnation)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr("learner.run.TrainingLoop", FakeLoop)
    monkeypatch.setattr("learner.run.open_cluster", open_cluster)
    monkeypatch.setattr("learner.run.final_evaluation", lambda config, cluster, weights: EPISODES)
    tracker, display = FakeTracker(), Messages()
    made = RunSession(RunFolder(tmp_path / "r"), small_run, tracker, display, ClusterOptions())
    return SimpleNamespace(
        execute=made.execute, outcomes=outcomes, incarnations=incarnations, tracker=tracker, display=display
    )


def test_a_finished_run_is_evaluated_and_logged(session):
    session.outcomes.append(True)
    finished = []
    result = session.execute(None, lambda result, rows: finished.append((result, rows)))
    assert (result.env_steps, result.updates, result.stopped_by) == (2_000, 50, None)
    assert result.evaluation.episodes == 2 and result.episodes is EPISODES and result.weights.version == 7
    assert finished == [(result, [])]
    assert session.tracker.results == [(1.0, 3_000)] and session.tracker.status == "FINISHED"


def test_a_lost_learner_leads_to_another_attempt(session):
    session.outcomes += [LOST, True]
    result = session.execute(None, lambda result, rows: None)
    assert result.evaluation is not None and session.tracker.status == "FINISHED"
    assert session.incarnations == [0, 5], "above every incarnation of the first attempt"
    assert "going on from the start" in session.display, "there is no checkpoint"


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), "KILLED"), (ValueError("a bug"), "FAILED")])
def test_an_error_ends_the_mlflow_run_with_its_status(session, error, status):
    session.outcomes.append(error)
    with pytest.raises(type(error)):
        session.execute(None, lambda result, rows: None)
    assert session.tracker.status == status and not session.tracker.results


def test_a_store_that_fails_at_the_end_is_reported_and_hides_no_result(session, monkeypatch):
    def fail(status):
        raise NoConnection("away")

    session.outcomes.append(True)
    monkeypatch.setattr(session.tracker, "end", fail)
    assert session.execute(None, lambda result, rows: None).evaluation is not None
    assert "MLflow does not know that the run is FINISHED: away" in session.display


def test_artifacts_that_mlflow_refuses_fail_the_run(session):
    def fail(result, rows):
        raise NoConnection("away")

    session.outcomes.append(True)
    with pytest.raises(NoConnection):
        session.execute(None, fail)
    assert session.tracker.status == "FAILED"
