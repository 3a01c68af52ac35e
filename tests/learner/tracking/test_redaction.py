"""Passwords in tracking URIs are neither shown nor stored."""

import pytest

from learner.tracking.redaction import full_uri, hide_secrets, public_uri
from sim_core.checks import ConfigError

SECRET = "http://me:s3cr%40et@host:5000/path"


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        (SECRET, "http://me:***@host:5000/path"),
        ("https://token@host", "https://***@host"),
        ("postgresql+psycopg2://u:pw@db/x?sslmode=require", "postgresql+psycopg2://u:***@db/x?sslmode=require"),
        ("postgresql://u@db/x", "postgresql://u@db/x"),
        ("http://host:5000/a:b@c", "http://host:5000/a:b@c"),
        ("sqlite:////home/you/runs/mlflow.db", "sqlite:////home/you/runs/mlflow.db"),
        ("http://[", "http://["),
        ("", ""),
    ],
)
def test_a_password_is_not_shown(uri, shown):
    assert public_uri(uri) == shown
    assert public_uri(shown) == shown


@pytest.mark.parametrize("secret", ["s3cr%40et", "s3cr@et"])
def test_client_errors_are_shown_without_the_password(secret):
    text = f"API request to http://me:{secret}@host:5000/api failed"
    assert hide_secrets(text, SECRET) == "API request to http://me:***@host:5000/api failed"


def test_a_stored_uri_gets_its_password_from_the_environment(monkeypatch):
    assert full_uri("http://host") == "http://host"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", SECRET)
    assert full_uri(public_uri(SECRET)) == SECRET
    for other in ("", "http://me:s3cr%40et@elsewhere:5000/path"):
        monkeypatch.setenv("MLFLOW_TRACKING_URI", other)
        with pytest.raises(ConfigError, match="password is not stored: set MLFLOW_TRACKING_URI"):
            full_uri(public_uri(SECRET))
