"""Who may speak to the Ray that a process starts or joins: tokens, and the loopback interface.

Ray decides by environment variables that it reads when it is imported. A Ray of our own listens on loopback alone and
asks for a token that only this process and its children have: neither the network nor another user of the machine can
make it run code. For a cluster that is joined, `ray start` asks for a token if its user has one, and so do we: a
process that asked for a token and has none would be refused before it has spoken to anybody.
"""

from __future__ import annotations

import os
import secrets
import sys
from pathlib import Path

from sim_core.checks import require

MODE = "RAY_AUTH_MODE"
TOKEN = "RAY_AUTH_TOKEN"
REMOTE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Whether Ray takes an address that others can reach, on any system in spite of its name; "0" is loopback alone."""
HOW = (
    "set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to the cluster's token "
    "(`ray get-auth-token` prints it there)"
)


def has_token() -> bool:
    """Whether Ray would find a token: in RAY_AUTH_TOKEN, in the file RAY_AUTH_TOKEN_PATH, or in ~/.ray/auth_token."""
    path = os.environ.get("RAY_AUTH_TOKEN_PATH")
    file = Path(path) if path else Path.home() / ".ray" / "auth_token"
    return bool(os.environ.get(TOKEN)) or file.is_file()


def guard_ray(joins: bool) -> None:
    """Sets what of these variables is not set; before Ray is imported.

    Args:
      joins: whether a cluster is joined that others can reach, rather than a Ray of our own started.

    Raises:
      ConfigError: a Ray of our own could not be guarded, as Ray has been imported and nothing is set.
    """
    if joins:
        os.environ.setdefault(MODE, "token" if has_token() else "disabled")
        return
    require(
        MODE in os.environ or "ray" not in sys.modules,
        "Ray was imported before it was decided who may speak to it; call learner.ray_backend.auth.guard_ray first, "
        f"or set {MODE} and {TOKEN}",
    )
    os.environ.setdefault(REMOTE, "0")
    if os.environ.setdefault(MODE, "token") == "token" and not has_token():
        os.environ[TOKEN] = secrets.token_hex(32)
