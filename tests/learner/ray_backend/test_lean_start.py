"""What a Ray of our own leaves out while it starts; tests/integration/test_leave.py looks at one that has started."""

import pytest

from learner.ray_backend import lean_start as tested
from learner.ray_backend.lean_start import UNUSED, lean_start


def test_all_that_is_left_out_is_part_of_this_ray_and_comes_back():
    before = [getattr(place, name) for place, name in UNUSED]
    with pytest.raises(ValueError, match="no start"), lean_start():
        assert all(getattr(place, name)(place) is None for place, name in UNUSED)
        raise ValueError("no start")
    assert [getattr(place, name) for place, name in UNUSED] == before


def test_a_ray_without_them_starts_as_it_does(monkeypatch):
    class Other:
        """Has none of them."""

    monkeypatch.setattr(tested, "UNUSED", ((Other, "start_monitor"),))
    with lean_start():
        assert not hasattr(Other, "start_monitor")
