"""Checkpoints in the background, in a folder, in memory and on an S3 server: complete or not there, whatever fails."""

import json
import threading
import uuid

import fsspec
import pytest

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Fault
from actors.service.rpc import LocalCalls, Placed
from actors.storage.fragment_writer import FragmentWriter
from actors.storage.uri import check_writable, fetched, join_location, parse_location
from learner.checkpoints.checkpoint import Retention, newest_valid
from learner.checkpoints.manifest import CheckpointError, UnusableCheckpointError
from learner.checkpoints.retention import Score
from learner.checkpoints.writer import CheckpointWriter, RunPosition
from sim_core.checks import ConfigError


class Node:
    """A node whose fragment is a folder with two files."""

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
        components = (Component(ComponentKind.LEARNER), Component(ComponentKind.WORKER, 3))
        pairs = zip(components, self.nodes.values(), strict=True)
        self.components = [Placed(component, 7, node) for component, node in pairs]
        self.writer = CheckpointWriter(root, LocalCalls(), 60.0)
        self.scores = []

    def save(self, env_steps, updates=0):
        draft = self.writer.draft(env_steps)
        for node in self.nodes.values():
            node.save(draft, f"{node.name} at {env_steps}, {updates}".encode())
        return draft

    def begin(self, env_steps, updates=0, newest=2, best=0):
        draft = self.save(env_steps, updates)
        state = {"env_steps": env_steps, "updates": updates}
        retention = Retention(newest, best, self.scores)
        self.writer.begin(
            RunPosition(env_steps, updates, 7 * env_steps), draft, state, self.components, lambda: retention
        )

    def write(self, *args, **kwargs):
        self.begin(*args, **kwargs)
        return self.writer.wait()

    def files(self):
        """Relative names of all files at the location."""
        files, path = fsspec.core.url_to_fs(str(self.root), use_listings_cache=False)
        return sorted(name.removeprefix(path).strip("/") for name in files.find(path))

    def steps(self):
        return sorted({int(name.split("/")[0].removeprefix("step-").split(".")[0]) for name in self.files()})

    def overwrite(self, name, content):
        files, path = fsspec.core.url_to_fs(str(self.root), use_listings_cache=False)
        files.pipe_file(f"{path}/{name}", content)


@pytest.fixture(params=["folder", "memory", "s3"])
def run(request, tmp_path):
    if request.param == "folder":
        return Run(parse_location(f"file://{tmp_path}/checkpoints"))
    if request.param == "memory":
        return Run(parse_location(f"memory://{uuid.uuid4()}/checkpoints/"))
    return Run(parse_location(f"{request.getfixturevalue('s3_server')}/{uuid.uuid4()}"))


def test_round_trip(run):
    result = run.write(100, 5)
    assert result.error is None and result.position == RunPosition(100, 5, 700)
    found, skipped = newest_valid(run.root)
    assert found.folder == result.location and not skipped
    assert found.state == {"env_steps": 100, "updates": 5}
    for name in run.nodes:
        with fetched(join_location(found.folder, name)) as path:
            assert (path / "rows").read_bytes() == f"{name} at 100, 5".encode()
            assert sorted(file.name for file in path.iterdir()) == ["more", "rows"]


def test_training_goes_on_while_a_checkpoint_is_written(run):
    slow = run.nodes["worker"]
    slow.go.clear()
    run.begin(100)
    assert run.writer.is_busy and run.writer.poll() is None
    with pytest.raises(UnusableCheckpointError):
        newest_valid(run.root)
    slow.go.set()
    assert run.writer.wait().error is None
    assert not run.writer.is_busy and run.writer.poll() is None and run.writer.wait() is None
    assert newest_valid(run.root)[0].state["env_steps"] == 100


def test_the_newest_and_the_best_are_kept(run):
    run.scores = [Score(100, 0.9), Score(200, 0.2), Score(300, 0.4)]
    for env_steps in (100, 200, 300, 400):
        assert run.write(env_steps, newest=2, best=1).error is None
    assert run.steps() == [100, 300, 400]


def test_a_full_disk_is_reported_once_and_the_older_checkpoint_stays(run):
    run.write(100)
    before = run.files()
    run.nodes["learner"].fails = True
    result = run.write(200)
    assert result.location is None and "No space left on device" in result.error
    assert run.writer.poll() is None and run.files() == before
    assert newest_valid(run.root)[0].state["env_steps"] == 100
    run.nodes["learner"].fails = False
    assert run.write(300).error is None
    assert newest_valid(run.root)[0].state["env_steps"] == 300


def test_a_component_that_never_finishes_writing_does_not_block_the_run(run, monkeypatch):
    monkeypatch.setattr("learner.checkpoints.writer.DEADLINE_S", 0.0)
    stuck = run.nodes["worker"]
    stuck.go.clear()
    assert "rollout worker 3 did not write within" in run.write(100).error
    run.begin(200)
    assert "still being written" in stuck.saved().error
    assert run.writer.wait().location is None
    stuck.go.set()
    for node in run.nodes.values():
        node._writer._thread.join(60)
    monkeypatch.undo()
    assert run.write(300).error is None and run.steps() == [300]


@pytest.mark.parametrize("fault", [Fault.DIED, Fault.UNREACHABLE])
def test_a_failed_component_is_reported_once_the_others_have_written(run, fault):
    run.write(100)
    before, slow = run.files(), run.nodes["learner"]
    slow.go.clear()
    run.nodes["worker"].fault = fault
    run.begin(200)
    run.writer._thread.join(0.3)
    assert run.writer.poll() is None
    run.nodes["worker"]._writer._thread.join(60)
    slow.go.set()
    result = run.writer.wait()
    assert result.location is None and "rollout worker 3" in result.error
    assert (result.failure.component, result.failure.incarnation, result.failure.fault) == (
        run.components[1].component,
        7,
        fault,
    )
    assert run.files() == before
    run.nodes["worker"].fault = None
    assert run.write(300).error is None and newest_valid(run.root)[0].state["env_steps"] == 300


def test_an_aborted_checkpoint_waits_for_the_components_that_had_begun(run):
    slow = run.nodes["learner"]
    slow.go.clear()
    run.save(100)
    failure = ComponentFailed(run.components[1].component, 7, Fault.DIED, "simulated")
    run.writer.abort(RunPosition(100, 0, 700), run.components[:1], failure)
    assert run.writer.is_busy and run.writer.poll() is None
    slow.go.set()
    result = run.writer.wait()
    assert result.location is None and result.failure is None and "rollout worker 3 died" in result.error
    run.nodes["worker"]._writer._thread.join(60)
    assert run.write(200).error is None and run.steps() == [200]


def test_a_component_that_does_not_answer_is_late(tmp_path):
    class Silent(LocalCalls):
        def wait(self, refs, timeout_s):
            return []

    run = Run(tmp_path / "checkpoints")
    run.writer = CheckpointWriter(run.root, Silent(), 0.1)
    result = run.write(100)
    assert result.failure.fault is Fault.LATE and "silent for 0 s" in result.error


def test_an_abandoned_checkpoint_ends_at_once_and_is_no_checkpoint(run):
    stuck = run.nodes["worker"]
    stuck.go.clear()
    run.begin(100)
    run.writer.abandon()
    assert not run.writer.is_busy
    with pytest.raises(UnusableCheckpointError):
        newest_valid(run.root)
    stuck.go.set()


def test_a_checkpoint_without_a_manifest_is_a_draft_and_is_removed(run):
    run.write(100)
    run.begin(200)
    run.writer.wait()
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


def test_a_second_checkpoint_at_the_same_step_is_the_newer_one(run):
    run.write(100, updates=1)
    run.write(100, updates=2)
    again = Run(run.root)
    again.write(100, updates=3)
    assert newest_valid(run.root)[0].state["updates"] == 3
    again.write(200, newest=1)
    assert run.steps() == [200]


def test_a_damaged_checkpoint_is_skipped_and_named(run):
    run.write(100)
    run.write(200)
    run.overwrite("step-000000000200/learner/rows", b"LEARNER at 200, 0")
    found, skipped = newest_valid(run.root)
    assert found.state["env_steps"] == 100
    assert len(skipped) == 1 and "step-000000000200" in skipped[0] and "learner/rows" in skipped[0]
    run.overwrite("step-000000000100/manifest.json", json.dumps({}).encode())
    with pytest.raises(UnusableCheckpointError, match="no usable checkpoint"):
        newest_valid(run.root)


def test_other_files_at_the_location_stay(run):
    run.write(100)
    run.overwrite("notes.txt", b"of mine")
    run.write(200, newest=1)
    assert {name.split("/")[0] for name in run.files()} == {"notes.txt", "step-000000000200"}


def test_a_missing_folder_costs_only_the_checkpoints_of_that_time(tmp_path):
    run = Run(tmp_path / "checkpoints")
    run.write(100)
    (tmp_path / "checkpoints").rename(tmp_path / "elsewhere")
    (tmp_path / "checkpoints").touch()  # like a lost mount: nothing can be created in it
    assert "checkpoints" in run.write(200).error
    (tmp_path / "checkpoints").unlink()
    (tmp_path / "elsewhere").rename(tmp_path / "checkpoints")
    assert newest_valid(run.root)[0].state["env_steps"] == 100
    assert run.write(300).error is None and run.steps() == [100, 300]


def test_a_missing_bucket_costs_only_the_checkpoints_of_that_time(s3_server):
    import s3fs

    bucket = f"gone-{uuid.uuid4()}"
    files = s3fs.S3FileSystem()
    files.mkdir(bucket)
    run = Run(f"s3://{bucket}/r")
    assert run.write(100, newest=1).error is None
    files.rm(bucket, recursive=True)
    result = run.write(200)
    assert result.location is None and "bucket" in result.error.lower()
    files.mkdir(bucket)
    assert run.write(300).error is None
    assert newest_valid(run.root)[0].state["env_steps"] == 300


def test_unusable_urls_are_refused_with_a_sentence(s3_server):
    with pytest.raises(ConfigError, match="cannot be written to.*name a folder or bucket"):
        check_writable("s3://no-such-bucket-here/x")
    with pytest.raises(ConfigError, match="nosuchprotocol://x cannot be opened"):
        check_writable("nosuchprotocol://x")
    with pytest.raises(ConfigError, match="must not hold a user or password"):
        parse_location("s3://key:secret@bucket/x")
    check_writable(f"{s3_server}/fine")
    with pytest.raises(CheckpointError, match="cannot be listed"):
        newest_valid("s3://no-such-bucket-here/x")
