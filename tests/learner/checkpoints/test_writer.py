"""Checkpoints in the background: in a folder, in memory and on a real S3 server, whole or not there whatever fails."""

import json
import threading
import uuid

import fsspec
import pytest

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Fault
from actors.service.rpc import LocalCalls
from actors.storage.fragment_writer import FragmentWriter
from actors.storage.uri import check_writable, fetched, join_location, parse_location
from learner.checkpoints.checkpoint import Retention, newest_valid
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.checkpoints.retention import Score
from learner.checkpoints.writer import CheckpointWriter, RunPosition, SavingComponent
from sim_core.checks import ConfigError


class Node:
    """A node that saves one file and one folder in it."""

    def __init__(self, name):
        self.name, self.content, self.go = name, b"", threading.Event()
        self.go.set()
        self._writer = FragmentWriter()
        self.fails = False
        self.fault = None

    def save(self, draft, content):
        self.content = content
        self._writer.start(join_location(draft, self.name), self._write)

    def _write(self, path):
        self.go.wait(60)
        path.mkdir(parents=True)
        (path / "rows").write_bytes(self.content)
        with open("/dev/full" if self.fails else path / "more", "wb") as file:
            file.write(b"more than nothing")

    def saved(self):
        if self.fault is not None:
            raise CallFailed(self.fault, "simulated")
        return self._writer.result()


class Run:
    """A run that checkpoints to a location."""

    def __init__(self, root):
        self.root = root
        self.nodes = {name: Node(name) for name in ("learner", "worker")}
        parts = (Component(ComponentKind.LEARNER), Component(ComponentKind.WORKER, 3))
        self.writers = [SavingComponent(part, 7, node) for part, node in zip(parts, self.nodes.values(), strict=True)]
        self.checkpointer = CheckpointWriter(root, LocalCalls(), 60.0)
        self.scores = []

    def save(self, env_steps, updates=0):
        draft = self.checkpointer.draft(env_steps)
        for node in self.nodes.values():
            node.save(draft, f"{node.name} at {env_steps}, {updates}".encode())
        return draft

    def begin(self, env_steps, updates=0, newest=2, best=0):
        draft = self.save(env_steps, updates)
        state = {"env_steps": env_steps, "updates": updates}
        keep = Retention(newest, best, self.scores)
        self.checkpointer.begin(
            RunPosition(env_steps, updates, 7 * env_steps), draft, state, self.writers, lambda: keep
        )

    def write(self, *args, **kwargs):
        self.begin(*args, **kwargs)
        return self.checkpointer.wait()

    def files(self):
        """All that lies at the location, by relative name."""
        files, path = fsspec.core.url_to_fs(str(self.root), use_listings_cache=False)
        return sorted(name.removeprefix(path).strip("/") for name in files.find(path))

    def steps(self):
        return sorted({int(name.split("/")[0].removeprefix("step-").split(".")[0]) for name in self.files()})

    def write_over(self, name, content):
        files, path = fsspec.core.url_to_fs(str(self.root), use_listings_cache=False)
        files.pipe_file(f"{path}/{name}", content)


@pytest.fixture(params=["folder", "memory", "s3"])
def run(request, tmp_path):
    if request.param == "folder":
        return Run(parse_location(f"file://{tmp_path}/checkpoints"))
    if request.param == "memory":
        return Run(parse_location(f"memory://{uuid.uuid4()}/checkpoints/"))
    return Run(parse_location(f"{request.getfixturevalue('s3_server')}/{uuid.uuid4()}"))


def test_what_was_written_is_read_back(run):
    ended = run.write(100, 5)
    assert ended.error is None and ended.position == RunPosition(100, 5, 700)
    found, skipped = newest_valid(run.root)
    assert found.folder == ended.location and not skipped
    assert found.state == {"env_steps": 100, "updates": 5}
    for name in run.nodes:
        with fetched(join_location(found.folder, name)) as path:
            assert (path / "rows").read_bytes() == f"{name} at 100, 5".encode()
            assert sorted(file.name for file in path.iterdir()) == ["more", "rows"]


def test_training_goes_on_while_a_checkpoint_is_written(run):
    slow = run.nodes["worker"]
    slow.go.clear()
    run.begin(100)
    assert run.checkpointer.is_busy and run.checkpointer.poll() is None
    with pytest.raises(UnusableCheckpointError):
        newest_valid(run.root)
    slow.go.set()
    assert run.checkpointer.wait().error is None
    assert not run.checkpointer.is_busy and run.checkpointer.poll() is None and run.checkpointer.wait() is None
    assert newest_valid(run.root)[0].state["env_steps"] == 100


def test_the_newest_and_the_best_are_kept(run):
    run.scores = [Score(100, 0.9), Score(200, 0.2), Score(300, 0.4)]
    for env_steps in (100, 200, 300, 400):
        assert run.write(env_steps, newest=2, best=1).error is None
    assert run.steps() == [100, 300, 400]


def test_a_full_disk_is_told_once_and_the_older_checkpoint_stays(run):
    run.write(100)
    before = run.files()
    run.nodes["learner"].fails = True
    ended = run.write(200)
    assert ended.location is None and "No space left on device" in ended.error
    assert run.checkpointer.poll() is None and run.files() == before
    assert newest_valid(run.root)[0].state["env_steps"] == 100
    run.nodes["learner"].fails = False
    assert run.write(300).error is None
    assert newest_valid(run.root)[0].state["env_steps"] == 300


def test_a_part_that_never_ends_does_not_hold_up_the_run(run, monkeypatch):
    monkeypatch.setattr("learner.checkpoints.writer.DEADLINE_S", 0.0)
    stuck = run.nodes["worker"]
    stuck.go.clear()
    assert "rollout worker 3 did not write within" in run.write(100).error
    run.begin(200)
    assert "still being written" in stuck.saved().error
    assert run.checkpointer.wait().location is None
    stuck.go.set()
    for node in run.nodes.values():
        node._writer._thread.join(60)
    monkeypatch.undo()
    assert run.write(300).error is None and run.steps() == [300]


@pytest.mark.parametrize("fault", [Fault.DIED, Fault.UNREACHABLE])
def test_a_part_that_fails_is_told_once_the_others_have_written(run, fault):
    run.write(100)
    before, slow = run.files(), run.nodes["learner"]
    slow.go.clear()
    run.nodes["worker"].fault = fault
    run.begin(200)
    run.checkpointer._thread.join(0.3)
    assert run.checkpointer.poll() is None
    run.nodes["worker"]._writer._thread.join(60)
    slow.go.set()
    ended = run.checkpointer.wait()
    assert ended.location is None and "rollout worker 3" in ended.error
    assert (ended.failure.component, ended.failure.incarnation, ended.failure.fault) == (
        run.writers[1].component,
        7,
        fault,
    )
    assert run.files() == before
    run.nodes["worker"].fault = None
    assert run.write(300).error is None and newest_valid(run.root)[0].state["env_steps"] == 300


def test_a_checkpoint_that_could_not_begin_waits_for_those_who_had_begun(run):
    slow = run.nodes["learner"]
    slow.go.clear()
    run.save(100)
    failure = ComponentFailed(run.writers[1].component, 7, Fault.DIED, "simulated")
    run.checkpointer.abort(RunPosition(100, 0, 700), run.writers[:1], failure)
    assert run.checkpointer.is_busy and run.checkpointer.poll() is None
    slow.go.set()
    ended = run.checkpointer.wait()
    assert ended.location is None and ended.failure is None and "rollout worker 3 died" in ended.error
    run.nodes["worker"]._writer._thread.join(60)
    assert run.write(200).error is None and run.steps() == [200]


def test_a_part_that_does_not_answer_is_late(tmp_path):
    class Silent(LocalCalls):
        def wait(self, refs, timeout_s):
            return []

    run = Run(tmp_path / "checkpoints")
    run.checkpointer = CheckpointWriter(run.root, Silent(), 0.1)
    ended = run.write(100)
    assert ended.failure.fault is Fault.LATE and "silent for 0 s" in ended.error


def test_what_is_given_up_ends_at_once_and_is_no_checkpoint(run):
    stuck = run.nodes["worker"]
    stuck.go.clear()
    run.begin(100)
    run.checkpointer.abandon()
    assert not run.checkpointer.is_busy
    with pytest.raises(UnusableCheckpointError):
        newest_valid(run.root)
    stuck.go.set()


def test_what_has_no_manifest_does_not_count_and_is_removed(run):
    run.write(100)
    run.begin(200)
    run.checkpointer.wait()
    manifest = next(name for name in run.files() if name.startswith("step-000000000200/manifest"))
    files, path = fsspec.core.url_to_fs(str(run.root), use_listings_cache=False)
    files.rm_file(f"{path}/{manifest}")
    assert newest_valid(run.root)[0].state["env_steps"] == 100
    again = Run(run.root)
    again.write(200)
    again.write(300, newest=9)
    whole = {name.split("/")[0] for name in run.files() if name.endswith("manifest.json")}
    if isinstance(run.root, str):
        assert {name.split("/")[0] for name in run.files()} == whole
    assert len(whole) == 3


def test_the_same_step_again_is_the_newer_one(run):
    run.write(100, updates=1)
    run.write(100, updates=2)
    again = Run(run.root)
    again.write(100, updates=3)
    assert newest_valid(run.root)[0].state["updates"] == 3
    again.write(200, newest=1)
    assert run.steps() == [200]


def test_a_damaged_one_is_skipped_and_said(run):
    run.write(100)
    run.write(200)
    run.write_over("step-000000000200/learner/rows", b"LEARNER at 200, 0")
    found, skipped = newest_valid(run.root)
    assert found.state["env_steps"] == 100
    assert len(skipped) == 1 and "step-000000000200" in skipped[0] and "learner/rows" in skipped[0]
    run.write_over("step-000000000100/manifest.json", json.dumps({}).encode())
    with pytest.raises(UnusableCheckpointError, match="no usable checkpoint"):
        newest_valid(run.root)


def test_what_else_lies_there_stays(run):
    run.write(100)
    run.write_over("notes.txt", b"of mine")
    run.write(200, newest=1)
    assert {name.split("/")[0] for name in run.files()} == {"notes.txt", "step-000000000200"}


def test_storage_that_is_gone_for_a_while_costs_the_checkpoints_of_that_while(tmp_path):
    run = Run(tmp_path / "checkpoints")
    run.write(100)
    (tmp_path / "checkpoints").rename(tmp_path / "elsewhere")
    (tmp_path / "checkpoints").touch()  # as a mount that is gone: nothing can be made there
    assert "checkpoints" in run.write(200).error
    (tmp_path / "checkpoints").unlink()
    (tmp_path / "elsewhere").rename(tmp_path / "checkpoints")
    assert newest_valid(run.root)[0].state["env_steps"] == 100
    assert run.write(300).error is None and run.steps() == [100, 300]


def test_a_bucket_that_is_gone_for_a_while_costs_the_checkpoints_of_that_while(s3_server):
    import s3fs

    bucket = f"gone-{uuid.uuid4()}"
    files = s3fs.S3FileSystem()
    files.mkdir(bucket)
    run = Run(f"s3://{bucket}/r")
    assert run.write(100, newest=1).error is None
    files.rm(bucket, recursive=True)
    ended = run.write(200)
    assert ended.location is None and "bucket" in ended.error.lower()
    files.mkdir(bucket)
    assert run.write(300).error is None
    assert newest_valid(run.root)[0].state["env_steps"] == 300


def test_urls_that_cannot_work_are_refused_with_a_sentence(s3_server):
    with pytest.raises(ConfigError, match="cannot be written to.*name a folder or bucket"):
        check_writable("s3://no-such-bucket-here/x")
    with pytest.raises(ConfigError, match="nosuchprotocol://x cannot be opened"):
        check_writable("nosuchprotocol://x")
    with pytest.raises(ConfigError, match="must not hold a user or password"):
        parse_location("s3://key:secret@bucket/x")
    check_writable(f"{s3_server}/fine")
    with pytest.raises(CheckpointError, match="cannot be listed"):
        newest_valid("s3://no-such-bucket-here/x")
