"""Commands in the background that tests kill."""

import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil

from tests.integration.conftest import PATIENCE_S, clean_environment


def wait_for(condition: Callable[[], bool], log: Callable[[], str], process: subprocess.Popen) -> None:
    """Waits until the condition holds; fails with the log when the process ends before, or after `PATIENCE_S`."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None, log()
        assert time.monotonic() < deadline_s, log()
        time.sleep(0.05)


def kill(process: subprocess.Popen) -> int:
    """Takes a driver, or a node, away as a power cut does: all its processes at once; returns how many there were."""
    driver = psutil.Process(process.pid)
    family = [*driver.children(recursive=True), driver]
    for member in family:
        with suppress(psutil.NoSuchProcess):  # it has ended meanwhile
            member.kill()
    psutil.wait_procs(family, timeout=PATIENCE_S)
    process.wait(PATIENCE_S)
    return len(family)


class Job:
    """`shoal` in the background, in an empty folder."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.folder = folder
        self.log = folder / "job.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deploy", *arguments],
                cwd=folder,
                env=clean_environment(),
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def wait_for(self, condition: Callable[[], bool]) -> None:
        wait_for(condition, self.log.read_text, self.process)

    def wait_for_files(self, pattern: str, count: int) -> None:
        """Waits until files of `count` different names under the folder have been seen while the job runs."""
        seen: set[Path] = set()

        def enough() -> bool:
            seen.update(path for path in self.folder.glob(pattern) if path.suffix != ".part")
            return len(seen) >= count

        self.wait_for(enough)

    def wait_for_checkpoints(self, run: str, count: int) -> None:
        self.wait_for_files(f"runs/{run}/checkpoints/step-*", count)

    def listening(self) -> set[str]:
        """Addresses on which the driver and its processes take connections."""
        driver = psutil.Process(self.process.pid)
        sockets = [each for process in [driver, *driver.children(recursive=True)] for each in process.net_connections()]
        return {each.laddr.ip.removeprefix("::ffff:") for each in sockets if each.status == psutil.CONN_LISTEN}

    def kill_all(self) -> None:
        """SIGKILL for the driver and every process that it started."""
        assert kill(self.process) > 3, "Ray runs in processes of its own"
