"""What all tests share: a process that any of them may start Ray in, its share of the tests, and moto's S3 server."""

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from learner.ray_backend.auth import guard_ray

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup has it ignored, and tests send it
guard_ray(joins=False)  # as `shoal` does: Ray reads this once, when the first test module imports it

BUCKET = "shoal-tests"
INDEPENDENT = ("test_faults.py", "test_peers.py", "test_process_run.py", "test_ray_run.py")
"""Integration tests that are long and share no fixture outside of a class: each may run in another process."""

LONGEST = ("slow_network", "search", "submitted_node_loss", "sweep", "submit", "ray_run", "faults", "supervise")
"""Integration tests with a Ray that take longest: none of them should be left alone at the end."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Shares modules out among pytest-xdist's processes, so that each makes a module's fixtures once.

    The last process takes modules from the end of the queue, where those that compute stand, while the others take
    those with a Ray, which wait more than they compute.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByModule(LoadScopeScheduling):  # type: ignore[misc]
        def _assign_work_unit(self, node: Any) -> None:
            if node is self.nodes[-1] and len(self.nodes) > 1:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            super()._assign_work_unit(node)

        def _split_scope(self, nodeid: str) -> str:
            module, test_or_class, *_ = nodeid.split("::")
            is_divided = module.removeprefix("tests/integration/") in INDEPENDENT
            return f"{module}::{test_or_class}" if is_divided else module

    return ByModule(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Puts tests with a Ray at the start of pytest-xdist's queue, the longest first, and other slow ones at its end."""
    ranks = {f"test_{name}": rank for rank, name in enumerate(LONGEST)}

    def place(item: pytest.Item) -> tuple[bool, int, bool]:
        rank = ranks.get(item.path.stem, len(ranks))
        return not item.get_closest_marker("ray"), rank, bool(item.get_closest_marker("slow"))

    if hasattr(config, "workerinput"):
        items.sort(key=place)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """URL of an empty bucket on a server of this machine, for this process and those that it starts."""
    from moto.server import ThreadedMotoServer  # a second that other tests need not wait

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    values = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_MAX_ATTEMPTS": "1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem().mkdir(f"s3://{BUCKET}")
        yield f"s3://{BUCKET}"
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()
    assert os.environ.get("AWS_ENDPOINT_URL") != values["AWS_ENDPOINT_URL"]
