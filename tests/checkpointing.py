"""What tests share that save a run or a node of it."""

import time


class Silent:
    """Watches nothing, and lets no checkpoint fail; implements `learner.loop.Observer`."""

    def row(self, row):
        pass

    def checkpoint(self, folder, journal_offset):
        pass

    def checkpoint_failed(self, env_steps, reason):
        raise AssertionError(reason)


def saved(node, location):
    """Has a node save itself and waits for the end; its state."""
    state, deadline_s = node.save(location), time.monotonic() + 60
    while (written := node.saved()) is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    assert written.error is None and written.files
    return state
