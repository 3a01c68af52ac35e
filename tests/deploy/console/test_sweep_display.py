"""The display of a sweep: the entries of its table, and its estimate of the time left."""

import io

import pytest

from actors.evaluation.result_table import ResultRow
from deploy.console import sweep_display
from deploy.console.sweep_display import LiveSweepDisplay, SweepDisplay, make_sweep_display
from deploy.console.terminal import plain_console
from learner.sweep.grid import SweepConfig, make_cells

SWEEP = SweepConfig(methods=("sensor",), robots=(5,), groups=(1, 2), seeds=(0, 1), baselines=("greedy",))
CELLS = make_cells(SWEEP)
NAMES = {cell.name: cell.key for cell in CELLS}


def rows(goal, episodes=100):
    return [
        ResultRow("thesis", "learned", "sensor", 5, 1, 0, 10, 1, 50, 50, 0, 0, 0, 0, 1.0, "0"),  # Extrapolation
        ResultRow("thesis", "learned", "sensor", 5, 1, 0, 5, 1, episodes, goal, episodes - goal, 0, 0, 0, 1.0, "0"),
    ]


def display_of(done=None, kind=SweepDisplay):
    console = plain_console(file=io.StringIO(), width=120)
    return kind(console, CELLS, done or {}), console


def text_of(display):
    console = plain_console(file=io.StringIO(), width=120)
    console.print(display.table())
    return console.file.getvalue()


def line_of(display, label):
    return next(line for line in text_of(display).splitlines() if label in line)


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(sweep_display.time, "monotonic", lambda: now[0])
    return now


def test_an_entry_shows_the_mean_over_seeds_and_how_many_are_missing():
    display, _ = display_of({NAMES["sensor 5r×1g s0"]: rows(90)})
    assert "90.0% (1/2)" in line_of(display, "│ sensor")
    display.finished(NAMES["sensor 5r×1g s1"], rows(70))
    assert "80.0%" in line_of(display, "│ sensor") and "(1/2)" not in line_of(display, "│ sensor")
    assert line_of(display, "greedy, sensor").count("·") == 2


def test_running_and_failed_cells_are_shown():
    display, console = display_of()
    key = NAMES["sensor 5r×2g s0"]
    display.started(key)
    display.progressed(key, CELLS[-1].config.total_env_steps // 2)
    assert "▸45%" in line_of(display, "│ sensor")
    display.failed(key, "OutOfMemoryError")
    assert "failed" in line_of(display, "│ sensor") and "▸" not in text_of(display)
    assert display.failures() == ["sensor 5r×2g s0: OutOfMemoryError"]
    assert "1 failed" in display.summary() and "OutOfMemoryError" in console.file.getvalue()
    display.started(key)
    assert not display.failures()


def test_the_time_left_is_estimated_from_the_weight_done_since_the_start(clock):
    first = NAMES["sensor 5r×1g s0"]
    display, _ = display_of({first: rows(90)})
    assert display.left_s() is None and "left" not in display.summary()
    weights = {cell.key: cell.weight for cell in CELLS}
    clock[0] += 60.0
    display.finished(NAMES["sensor 5r×1g s1"], rows(90))
    left = sum(weights.values()) - weights[first] - weights[NAMES["sensor 5r×1g s1"]]
    assert display.left_s() == pytest.approx(60.0 * left / weights[NAMES["sensor 5r×1g s1"]])
    assert f"[2 of {len(CELLS)} cells, 0 running" in display.summary()


def test_a_log_gets_one_line_per_cell_and_a_terminal_the_table():
    display, console = display_of()
    display.finished(NAMES["sensor 5r×1g s0"], rows(55))
    assert "sensor 5r×1g s0: success 55.0%" in console.file.getvalue()
    live, terminal = display_of(kind=LiveSweepDisplay)
    live.finished(NAMES["sensor 5r×1g s0"], rows(55))
    assert terminal.file.getvalue() == ""
    with live:
        pass
    assert type(make_sweep_display(plain_console(file=io.StringIO()), CELLS, {})) is SweepDisplay
    assert (
        type(make_sweep_display(plain_console(file=io.StringIO(), force_terminal=True), CELLS, {})) is LiveSweepDisplay
    )
