"""Where a Ray of our own keeps its sockets."""

from pathlib import Path

import pytest

from learner.ray_backend import temp_folder
from learner.ray_backend.temp_folder import SOCKET, own_temp_folder
from sim_core.checks import ConfigError


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch):
    for name in ("RAY_TMPDIR", "TMPDIR"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def short(monkeypatch, tmp_path):
    """Stands in for /tmp."""
    monkeypatch.setattr(temp_folder, "SHORT", (str(tmp_path / "short"),))
    return tmp_path / "short"


def test_rays_own_folder_will_do_where_it_is_short(monkeypatch):
    assert own_temp_folder() is None
    monkeypatch.setenv("TMPDIR", "/var/tmp")
    assert own_temp_folder() is None


@pytest.mark.parametrize("name", ["RAY_TMPDIR", "TMPDIR"])
@pytest.mark.parametrize("letter", ["x", "\N{GREEK SMALL LETTER ALPHA}"])
def test_a_path_that_is_too_long_for_a_socket_is_not_taken(monkeypatch, tmp_path, short, name, letter):
    monkeypatch.setenv(name, str(tmp_path / (letter * 60)))
    made = own_temp_folder()
    assert made.parent == short and made.is_dir() and made.stat().st_mode & 0o777 == 0o700


def test_a_folder_that_cannot_be_written_to_is_not_taken(monkeypatch, tmp_path, short):
    monkeypatch.setenv("TMPDIR", "/proc/x")
    assert own_temp_folder().parent == short


def test_without_any_folder_that_will_do_a_sentence_says_so(monkeypatch):
    monkeypatch.setattr(temp_folder, "SHORT", ("/proc/x",))
    monkeypatch.setenv("TMPDIR", "/dev/null/x")
    with pytest.raises(ConfigError, match="/dev/null/x.*set RAY_TMPDIR to a folder with a short path"):
        own_temp_folder()


def test_the_longest_socket_is_that_of_ray():
    assert len(SOCKET) == len("ray/session_2026-11-30_12-08-16_123456_4194304/sockets/plasma_store")
    assert len(str(Path("/tmp") / SOCKET)) < temp_folder.LONGEST < 107
