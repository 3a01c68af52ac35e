"""When the driver of a training over Ray imports what the end needs, and what it shows meanwhile."""

import threading

import pytest

from deploy.runs import end_imports
from deploy.runs.end_imports import MODULES, EndImports
from learner.tracking.journal import Row


class Shown:
    def __init__(self):
        self.rows, self.messages = [], []
        self.row, self.message = self.rows.append, self.messages.append


@pytest.fixture
def imported(monkeypatch):
    """Names of the modules that were imported so far."""
    names = []
    monkeypatch.setattr(end_imports.importlib, "import_module", names.append)

    def wait():
        for thread in threading.enumerate():
            if thread.name == "end-imports":
                thread.join()
        return tuple(names)

    return wait


def test_the_first_row_of_the_second_half_begins_the_imports_once(imported):
    shown = Shown()
    display = EndImports(shown, 1_000)
    rows = [Row(env_steps, 0, {}) for env_steps in (0, 499, 500, 900, 400, 1_000)]
    for row in rows[:2]:
        display.row(row)
    assert imported() == ()
    display.row(rows[2])
    assert imported() == MODULES
    for row in rows[3:]:
        display.row(row)
    display.message("a fault")
    assert imported() == MODULES and shown.rows == rows and shown.messages == ["a fault"]
