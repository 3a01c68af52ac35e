"""Removes passwords from tracking URIs before they are shown or stored."""

from __future__ import annotations

import os
from urllib.parse import unquote, urlsplit

from sim_core.checks import ConfigError

HIDDEN = "***"
VARIABLE = "MLFLOW_TRACKING_URI"


def _secrets(uri: str) -> list[str]:
    """The password of a URI, percent-encoded and decoded; with HTTP, a user name without a password may be a token."""
    try:
        parts = urlsplit(uri)
        found = parts.password or (parts.username if parts.scheme in ("http", "https") else None)
    except ValueError:  # not a URI
        return []
    return [secret for secret in dict.fromkeys([found or "", unquote(found or "")]) if secret]


def hide_secrets(text: str, uri: str) -> str:
    """`text`, such as an error of MLflow's client, with the password of `uri` replaced by `***`."""
    for secret in _secrets(uri):
        for before in (":", "//"):
            text = text.replace(f"{before}{secret}@", f"{before}{HIDDEN}@")
    return text


def public_uri(uri: str) -> str:
    """`uri` with its password replaced by `***`."""
    return hide_secrets(uri, uri)


def full_uri(stored: str) -> str:
    """The URI with its password, taken from the environment variable MLFLOW_TRACKING_URI where `stored` hides one.

    Raises:
      ConfigError: the variable does not hold that URI.
    """
    if f"{HIDDEN}@" not in stored:
        return stored
    given = os.environ.get(VARIABLE, "")
    if public_uri(given) != stored:
        raise ConfigError(
            f"the run is logged to {stored}, whose password is not stored: set {VARIABLE} to the whole URI"
        )
    return given
