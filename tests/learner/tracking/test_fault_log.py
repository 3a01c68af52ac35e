"""The log of faults: entries round-trip, and half-written lines of killed drivers are skipped."""

from contextlib import closing

from actors.service.fault_policy import Action, Component, ComponentFailed, ComponentKind, Decision, Fault, Recovered
from learner.tracking.fault_log import FaultLog, read_faults

WORKER = Component(ComponentKind.WORKER, 2)


def test_entries_round_trip_in_order(tmp_path):
    path = tmp_path / "run" / "faults.jsonl"
    with closing(FaultLog(path)) as log:
        log.failed(ComponentFailed(WORKER, 0, Fault.LATE, "silent"), Decision(Action.RESTART, 2))
        log.recovered(Recovered(WORKER, Fault.LATE, Action.RESTART, 2, 1.5))
        log.resumed()
    entries = read_faults(path)
    assert [entry[1:] for entry in entries] == [
        ("failed", "rollout worker 2", "late", "restart", 2, 0.0),
        ("mended", "rollout worker 2", "late", "restart", 2, 1.5),
        ("resumed", "driver", "died", "resume", 1, 0.0),
    ]
    assert sorted(entry.time_s for entry in entries) == [entry.time_s for entry in entries]


def resume(path):
    with closing(FaultLog(path)) as log:
        log.resumed()


def test_a_half_written_line_is_skipped_and_spoils_no_other(tmp_path):
    path = tmp_path / "faults.jsonl"
    assert read_faults(path) == []
    resume(path)
    whole = path.read_text()
    path.write_text(whole + whole[:20])
    assert len(read_faults(path)) == 1
    resume(path)  # its line is appended to the half-written one
    resume(path)
    assert len(read_faults(path)) == 2
    with path.open("a") as file:
        file.write("[" * 100_000 + "\n7\n[1]\n")
    assert len(read_faults(path)) == 2
