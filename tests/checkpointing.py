"""Helpers of tests that save a run or one of its nodes."""

import time


class Silent:
    """Ignores all events but a failed checkpoint, which fails the test; implements `learner.loop.Observer`."""

    def row(self, row):
        pass

    def checkpoint(self, folder, journal_offset):
        pass

    def checkpoint_failed(self, env_steps, reason):
        raise AssertionError(reason)


def saved(node, location):
    """Has a node save itself, waits until it has, and returns its state."""
    state, deadline_s = node.save(location), time.monotonic() + 60
    while (written := node.saved()) is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    assert written.error is None and written.files
    return state
