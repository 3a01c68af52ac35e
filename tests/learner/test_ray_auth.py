"""Whether a process shows a token to Ray."""

import os

import pytest

from learner.ray_auth import set_auth_mode


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch, tmp_path):
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))


def mode(joins: bool) -> str:
    set_auth_mode(joins)
    return os.environ["RAY_AUTH_MODE"]


def test_without_a_token_none_is_shown():
    assert mode(joins=True) == "disabled"


def test_a_ray_of_our_own_asks_for_none(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    assert mode(joins=False) == "disabled"


@pytest.mark.parametrize("where", ["variable", "file", "home"])
def test_a_token_is_found_where_ray_looks(where, monkeypatch, tmp_path):
    if where == "variable":
        monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    elif where == "file":
        (tmp_path / "token").write_text("a")
        monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    else:
        (tmp_path / ".ray").mkdir()
        (tmp_path / ".ray" / "auth_token").write_text("a")
    assert mode(joins=True) == "token"


def test_what_the_user_has_set_stays(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    assert mode(joins=True) == "disabled"
