"""Every moment belongs to one activity."""

from actors.service.stopwatch import Stopwatch


def test_time_between_two_laps_belongs_to_the_later_one():
    now = iter([10.0, 11.0, 13.0, 16.0, 20.0])
    watch = Stopwatch(lambda: next(now))
    for activity in ("start", "a", "b", "a"):
        watch.lap(activity)
    assert watch.take() == {"a": 4.0, "b": 2.0}
    assert watch.take() == {}
    watch.lap("b")
    assert watch.take() == {"b": 4.0}
