"""When a training begins to load what its end needs, and what it shows meanwhile."""

import threading

import pytest

from deploy.runs import end_imports
from deploy.runs.end_imports import DRAWS, EndImports
from learner.tracking.journal import Row


class Shown:
    """A display, and a run in MLflow that counts how often the end was to be loaded."""

    def __init__(self):
        self.rows, self.messages, self.loads = [], [], 0
        self.row, self.message = self.rows.append, self.messages.append

    def load_end(self):
        self.loads += 1


@pytest.mark.parametrize(("waits", "expected"), [(True, [DRAWS]), (False, [])])
def test_the_first_row_begins_the_imports_once(waits, expected, monkeypatch):
    imported, shown = [], Shown()
    monkeypatch.setattr(end_imports.importlib, "import_module", imported.append)
    display = EndImports(shown, shown, waits)
    display.message("a fault")
    assert shown.loads == 0
    rows = [Row(env_steps, 0, {}) for env_steps in (0, 500, 400)]
    for row in rows:
        display.row(row)
    for thread in threading.enumerate():
        if thread.name == "end-imports":
            thread.join()
    assert imported == expected and shown.loads == 1
    assert shown.rows == rows and shown.messages == ["a fault"]
