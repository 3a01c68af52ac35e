"""Access to the Ray that a process starts or joins."""

import os
import sys

import pytest

from learner.ray_backend.auth import REMOTE, guard_ray
from sim_core.checks import ConfigError


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch, tmp_path):
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", REMOTE):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delitem(sys.modules, "ray", raising=False)


def mode(joins: bool) -> str:
    guard_ray(joins)
    return os.environ["RAY_AUTH_MODE"]


def test_a_cluster_is_joined_without_a_token_if_the_user_has_none():
    assert mode(joins=True) == "disabled"


def test_a_user_without_a_home_has_no_token(monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 7)  # whom the system does not know
    assert mode(joins=True) == "disabled"


def test_a_local_ray_listens_on_loopback_and_requires_its_own_token():
    assert mode(joins=False) == "token" and os.environ[REMOTE] == "0"
    token = os.environ["RAY_AUTH_TOKEN"]
    assert len(token) == 64
    assert mode(joins=False) == "token" and os.environ["RAY_AUTH_TOKEN"] == token, "made once"


def test_a_local_ray_requires_the_token_of_the_user(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    assert mode(joins=False) == "token" and os.environ["RAY_AUTH_TOKEN"] == "a"


def test_a_cluster_is_joined_by_its_own_address():
    mode(joins=True)
    assert REMOTE not in os.environ and "RAY_AUTH_TOKEN" not in os.environ


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


def test_variables_of_the_user_are_kept(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a")
    assert mode(joins=True) == "disabled"


def test_ray_is_not_started_if_it_was_imported_unguarded(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", object())
    with pytest.raises(ConfigError, match=r"guard_ray first, or set RAY_AUTH_MODE and RAY_AUTH_TOKEN"):
        guard_ray(joins=False)
    assert REMOTE not in os.environ
