"""The processes of a training over Ray, by what they do."""

import psutil

from deploy.chaos_processes import TITLES


def kind_of(process: psutil.Process) -> str:
    """What a process of the run's does."""
    words = process.cmdline() or [process.name()]
    for kind, title in TITLES.items():
        if words[0].startswith(title):
            return kind
    if words[0].startswith("ray::IDLE"):
        return "idle worker of Ray"
    return next((name for name in ("raylet", "gcs_server") if name in words[0]), "other process of Ray")


def cpu_seconds() -> dict[str, float]:
    """CPU time that this process, the driver, and its children have spent so far, by kind."""
    driver = psutil.Process()
    spent: dict[str, float] = {}
    for process in [driver, *driver.children(recursive=True)]:
        try:
            with process.oneshot():
                kind = "driver" if process == driver else kind_of(process)
                times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        spent[kind] = spent.get(kind, 0.0) + times.user + times.system
    return spent
