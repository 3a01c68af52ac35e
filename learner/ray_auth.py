"""How this process shows itself to a Ray cluster: with a token, or not at all.

Ray decides by RAY_AUTH_MODE. Where it is not set, `ray start` asks for a token if its user has one, and so do we: a
process that asked for a token and has none would be refused before it has spoken to anybody.
"""

from __future__ import annotations

import os
from pathlib import Path

MODE = "RAY_AUTH_MODE"
HOW = (
    "set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to the cluster's token "
    "(`ray get-auth-token` prints it there)"
)


def has_token() -> bool:
    """Whether Ray would find a token: in RAY_AUTH_TOKEN, in the file RAY_AUTH_TOKEN_PATH, or in ~/.ray/auth_token."""
    path = os.environ.get("RAY_AUTH_TOKEN_PATH")
    file = Path(path) if path else Path.home() / ".ray" / "auth_token"
    return bool(os.environ.get("RAY_AUTH_TOKEN")) or file.is_file()


def set_auth_mode(joins: bool) -> None:
    """Sets RAY_AUTH_MODE where it is not set; before Ray is imported, which reads it then.

    Args:
      joins: whether a cluster is joined that others can reach, rather than a Ray of our own started.
    """
    os.environ.setdefault(MODE, "token" if joins and has_token() else "disabled")
