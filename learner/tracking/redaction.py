"""Addresses that may hold a password: shown and stored without it."""

from __future__ import annotations

import os
from urllib.parse import unquote, urlsplit

from sim_core.checks import ConfigError

HIDDEN = "***"
VARIABLE = "MLFLOW_TRACKING_URI"


def _secrets(uri: str) -> list[str]:
    """Passwords of a URI, as written and as meant; a user name alone may be a token."""
    try:
        parts = urlsplit(uri)
        found = parts.password or (parts.username if parts.scheme in ("http", "https") else None)
    except ValueError:  # no URI
        return []
    return [secret for secret in dict.fromkeys([found or "", unquote(found or "")]) if secret]


def hide_secrets(text: str, uri: str) -> str:
    """A text, such as a client's error, without the password of the URI that it is about."""
    for secret in _secrets(uri):
        for before in (":", "//"):
            text = text.replace(f"{before}{secret}@", f"{before}{HIDDEN}@")
    return text


def public_uri(uri: str) -> str:
    """The URI as it may be shown and stored."""
    return hide_secrets(uri, uri)


def full_uri(stored: str) -> str:
    """The URI behind a stored one: itself, or, if it had a password, that of MLFLOW_TRACKING_URI.

    Raises:
      ConfigError: the variable does not hold it.
    """
    if f"{HIDDEN}@" not in stored:
        return stored
    given = os.environ.get(VARIABLE, "")
    if public_uri(given) != stored:
        raise ConfigError(
            f"the run is logged to {stored}, whose password is not stored: set {VARIABLE} to the whole URI"
        )
    return given
