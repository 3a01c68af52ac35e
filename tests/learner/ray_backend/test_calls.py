"""The faults that Ray's errors stand for, without a cluster."""

import pytest
from ray import exceptions as ray_errors

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Fault
from learner.ray_backend import calls as ray_calls
from learner.ray_backend.calls import RayCalls

DIED = ray_errors.ActorDiedError()
OWNER = ray_errors.OwnerDiedError("0" * 56, None, "")
ERRORS = [
    (DIED, Fault.DIED),
    (ray_errors.ActorUnavailableError("connection reset", None), Fault.UNREACHABLE),
    (ray_errors.WorkerCrashedError(), Fault.DIED),
    (ray_errors.NodeDiedError("node lost"), Fault.DIED),
    (ray_errors.OutOfMemoryError("killed by the memory monitor"), Fault.DIED),
    (ray_errors.TaskCancelledError(), Fault.DIED),
    (OWNER, Fault.OBJECT_LOST),
    (ray_errors.ObjectLostError("0" * 56, None, ""), Fault.OBJECT_LOST),
    (ray_errors.ObjectReconstructionFailedError("0" * 56, None, ""), Fault.OBJECT_LOST),
    (ray_errors.GetTimeoutError("timed out"), Fault.LATE),
]


@pytest.fixture
def get(monkeypatch):
    """Function: what `RayCalls.get` raises where Ray raises `error`."""

    def raised_for(error):
        def failing_get(ref, timeout):
            raise error

        monkeypatch.setattr(ray_calls.ray, "get", failing_get)
        with pytest.raises(Exception) as caught:  # noqa: PT011 - the test looks at it
            RayCalls(5.0).get("ref")
        return caught.value

    return raised_for


@pytest.mark.parametrize(("error", "fault"), ERRORS, ids=lambda value: type(value).__name__)
def test_an_error_of_ray_is_a_fault(get, error, fault):
    raised = get(error)
    assert type(raised) is CallFailed and raised.fault is fault
    assert raised.reason and "\n" not in raised.reason


@pytest.mark.parametrize(
    "cause",
    [
        ComponentFailed(Component(ComponentKind.SHARD, 1), 3, Fault.LATE, "silent"),
        CallFailed(Fault.OBJECT_LOST, "no weights"),
    ],
)
def test_a_fault_that_a_node_raised_is_unchanged(get, cause):
    raised = get(ray_errors.RayTaskError("update", "trace", cause).as_instanceof_cause())
    assert type(raised) is type(cause) and vars(raised) == vars(cause)


def test_an_argument_that_was_lost_is_a_fault(get):
    assert get(ray_errors.RayTaskError("evaluate", "trace", OWNER).as_instanceof_cause()).fault is Fault.OBJECT_LOST


def test_an_error_of_our_own_code_is_unchanged(get):
    raised = get(ray_errors.RayTaskError("load", "trace", ValueError("another shape")).as_instanceof_cause())
    assert isinstance(raised, ValueError) and not isinstance(raised, CallFailed)


def test_a_deadline_names_its_seconds(get):
    assert "5 s" in get(ray_errors.GetTimeoutError("timed out")).reason
