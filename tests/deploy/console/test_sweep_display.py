"""The board of a sweep: what stands in its cells, and how long it says the rest will take."""

import io

import pytest
from rich.console import Console

from actors.evaluation.result_table import ResultRow
from deploy.console import sweep_display
from deploy.console.sweep_display import LiveSweepDisplay, SweepDisplay, make_sweep_display
from learner.sweep.grid import SweepConfig, make_cells

SWEEP = SweepConfig(methods=("sensor",), robots=(5,), groups=(1, 2), seeds=(0, 1), baselines=("greedy",))
CELLS = make_cells(SWEEP)
NAMES = {cell.name: cell.key for cell in CELLS}


def rows(goal, episodes=100):
    return [
        ResultRow("thesis", "learned", "sensor", 5, 1, 0, 10, 1, 50, 50, 0, 0, 0, 0, 1.0, "0"),  # Extrapolation
        ResultRow("thesis", "learned", "sensor", 5, 1, 0, 5, 1, episodes, goal, episodes - goal, 0, 0, 0, 1.0, "0"),
    ]


def board_of(done=None, kind=SweepDisplay):
    console = Console(file=io.StringIO(), width=120)
    return kind(console, CELLS, done or {}), console


def text_of(board):
    console = Console(file=io.StringIO(), width=120)
    console.print(board.table())
    return console.file.getvalue()


def line_of(board, label):
    return next(line for line in text_of(board).splitlines() if label in line)


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(sweep_display.time, "monotonic", lambda: now[0])
    return now


def test_a_cell_shows_the_mean_of_its_seeds_and_what_is_missing():
    board, _ = board_of({NAMES["sensor 5r×1g s0"]: rows(90)})
    assert "90.0% (1/2)" in line_of(board, "│ sensor")
    board.finished(NAMES["sensor 5r×1g s1"], rows(70))
    assert "80.0%" in line_of(board, "│ sensor") and "(1/2)" not in line_of(board, "│ sensor")
    assert line_of(board, "greedy, sensor").count("·") == 2


def test_a_running_cell_shows_how_far_it_is_and_a_failed_one_says_so():
    board, console = board_of()
    key = NAMES["sensor 5r×2g s0"]
    board.started(key)
    board.progressed(key, CELLS[-1].config.total_env_steps // 2)
    assert "▸45%" in line_of(board, "│ sensor")
    board.failed(key, "OutOfMemoryError")
    assert "failed" in line_of(board, "│ sensor") and "▸" not in text_of(board)
    assert board.failures() == ["sensor 5r×2g s0: OutOfMemoryError"]
    assert "1 failed" in board.summary() and "OutOfMemoryError" in console.file.getvalue()
    board.started(key)
    assert not board.failures()


def test_the_time_left_goes_by_the_weight_of_what_is_done_since_the_start(clock):
    first = NAMES["sensor 5r×1g s0"]
    board, _ = board_of({first: rows(90)})
    assert board.left_s() is None and "left" not in board.summary()
    weights = {cell.key: cell.weight for cell in CELLS}
    clock[0] += 60.0
    board.finished(NAMES["sensor 5r×1g s1"], rows(90))
    left = sum(weights.values()) - weights[first] - weights[NAMES["sensor 5r×1g s1"]]
    assert board.left_s() == pytest.approx(60.0 * left / weights[NAMES["sensor 5r×1g s1"]])
    assert f"[2 of {len(CELLS)} cells, 0 running" in board.summary()


def test_a_log_gets_a_line_a_cell_and_a_terminal_the_table():
    board, console = board_of()
    board.finished(NAMES["sensor 5r×1g s0"], rows(55))
    assert "sensor 5r×1g s0: success 55.0%" in console.file.getvalue()
    live, terminal = board_of(kind=LiveSweepDisplay)
    live.finished(NAMES["sensor 5r×1g s0"], rows(55))
    assert terminal.file.getvalue() == ""
    with live:
        pass
    assert type(make_sweep_display(Console(file=io.StringIO()), CELLS, {})) is SweepDisplay
    assert type(make_sweep_display(Console(file=io.StringIO(), force_terminal=True), CELLS, {})) is LiveSweepDisplay
