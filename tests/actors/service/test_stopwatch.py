"""Every moment counts for one thing."""

from actors.service.stopwatch import Stopwatch


def test_time_between_laps_is_for_what_the_later_says():
    now = iter([10.0, 11.0, 13.0, 16.0, 20.0])
    watch = Stopwatch(lambda: next(now))
    for what in ("start", "a", "b", "a"):
        watch.lap(what)
    assert watch.take() == {"a": 4.0, "b": 2.0}
    assert watch.take() == {}
    watch.lap("b")
    assert watch.take() == {"b": 4.0}
