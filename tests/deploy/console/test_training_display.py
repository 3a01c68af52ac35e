"""The displays of a running training."""

import io

import pytest

from deploy.console import training_display
from deploy.console.terminal import plain_console
from deploy.console.training_display import LatestMetrics, LiveDisplay, PlainDisplay, make_display
from learner.tracking.journal import Row

SPEEDS = {"speed/env_steps_per_s": 12345.6, "speed/updates_per_s": 78.9}


def make_console(terminal=False, term="xterm-256color"):
    environment = {"TERM": term, "COLUMNS": "160"}
    return plain_console(file=io.StringIO(), force_terminal=terminal, width=160, height=20, _environ=environment)


def lines(console):
    return console.file.getvalue().splitlines()


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""
    now = [1000.0]
    monkeypatch.setattr(training_display.time, "monotonic", lambda: now[0])
    return now


def row(env_steps, **metrics):
    return Row(env_steps, 0, {name.replace("__", "/"): value for name, value in metrics.items()} | SPEEDS)


@pytest.mark.parametrize(
    ("metrics", "text"),
    [
        ({"train/success_rate": 0.256, "train/return": 1.0}, "train success 26%"),
        ({"eval/success_rate": 0.5, "train/success_rate": 0.25}, "eval success 50%  train success 25%"),
        ({"train/return": 17.26}, "train return 17.3"),
        ({"eval/return": -3.0, "train/return": 17.0}, "eval return -3.0  train return 17.0"),
        ({"eval/success_rate": 0.0}, "eval success 0%"),
    ],
)
def test_the_newest_metrics_in_a_line(metrics, text):
    latest = LatestMetrics()
    latest.update(Row(1, 0, metrics | SPEEDS))
    assert latest.text() == f"{text}  12,346 env steps/s  79 updates/s"


def test_metrics_missing_from_a_row_keep_their_values():
    latest = LatestMetrics()
    latest.update(Row(1, 0, {"eval/success_rate": 0.5}))
    latest.update(Row(2, 0, {"speed/updates_per_s": 3.0}))
    latest.update(Row(3, 0, {"eval/success_rate": 0.75}))
    assert latest.text() == "eval success 75%  0 env steps/s  3 updates/s"


def test_plain_lines_come_at_most_every_5_seconds(clock):
    console = make_console()
    with PlainDisplay(console, 1000) as display:
        for second in range(17):
            display.row(row(second * 10))
            clock[0] += 1
    assert [line.split()[0] for line in lines(console)] == ["0", "50", "100", "150"]


def test_a_plain_line_shows_progress_metrics_and_time_left(clock):
    console = make_console()
    display = PlainDisplay(console, 100_000)
    display.row(row(10_000, train__success_rate=0.25))
    clock[0] += 10
    display.row(row(30_000))
    first, second = lines(console)
    assert first == "10,000 env steps (10%)  train success 25%  12,346 env steps/s  79 updates/s"
    # 20,000 env steps took 10 s and 70,000 are left. The 10,000 before the first row do not count, as in a resumed run.
    assert second == "30,000 env steps (30%)  train success 25%  12,346 env steps/s  79 updates/s  35 s left"


def test_a_row_between_two_lines_still_counts(clock):
    console = make_console()
    display = PlainDisplay(console, 1000)
    display.row(row(1))
    display.row(row(2, eval__success_rate=0.5))
    clock[0] += 5
    display.row(row(3))
    assert "eval success 50%" in lines(console)[1]


def test_the_first_row_of_a_freshly_started_machine_is_shown(clock):
    clock[0] = 1.5
    console = make_console()
    PlainDisplay(console, 1000).row(row(1))
    assert len(lines(console)) == 1


def test_messages_are_printed_at_once_and_unwrapped(clock):
    console = make_console()
    display = PlainDisplay(console, 1000)
    display.row(row(1))
    long = "training done; evaluating " + "many " * 60 + "greedy episodes"
    display.message(long)
    display.message("next")
    assert lines(console)[1:] == [long, "next"]


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("text", ["see /runs/one [shoal]", "odd [/path]"])
def test_brackets_in_messages_are_shown(terminal, text):
    console = make_console(terminal)
    with make_display(console, 1000) as display:
        display.message(text)
    assert text in console.file.getvalue()


def test_the_live_display_shows_success_speeds_and_time_left():
    console = make_console(terminal=True)
    with LiveDisplay(console, 1000) as display:
        display.row(row(0))
        display.row(row(250, eval__success_rate=0.5, train__success_rate=0.25))
        display.message("a checkpoint")
        text = plain_console(file=io.StringIO(), width=160)
        text.print(display._progress.get_renderable())
    drawn = text.file.getvalue()
    for part in ("25%", "eval success 50%", "train success 25%", "12,346 env steps/s", "79 updates/s", "left"):
        assert part in drawn
    assert "a checkpoint" in console.file.getvalue()
    assert "\x1b[" in console.file.getvalue()


def test_the_live_display_estimates_the_time_left_and_never_goes_back():
    console, now = make_console(terminal=True), [0.0]
    display = LiveDisplay(console, 1000)
    display._progress.get_time = lambda: now[0]
    with display:
        for env_steps in (0, 100, 200, 300):
            display.row(row(env_steps))
            now[0] += 10
        task = display._progress.tasks[0]
        assert task.time_remaining == pytest.approx(70, abs=1)
        display.row(Row(150, 0, {"eval/success_rate": 1.0}))  # an evaluation that began 150 env steps ago
        assert task.completed == 300 and "eval success 100%" in task.fields["metrics"]


@pytest.mark.parametrize(
    ("terminal", "term", "kind"),
    [(True, "xterm", LiveDisplay), (True, "dumb", PlainDisplay), (False, "xterm", PlainDisplay)],
)
def test_the_console_decides_which_display_is_used(terminal, term, kind):
    assert type(make_display(make_console(terminal, term), 10)) is kind
