"""Access to the Ray that a process starts or joins: token authentication, and the loopback interface.

Ray is configured by environment variables, which it reads when it is imported. A Ray that this process starts listens
on loopback alone and requires a token that only this process and its children hold, so neither the network nor another
user of the machine can make it run code. When a cluster is joined, tokens are used if the user has one, as `ray start`
does: a process that turns authentication on without a token cannot connect to any cluster.
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
"""Whether Ray listens on an address that others can reach, on any system despite its name; "0" is loopback alone."""
TOKEN_HELP = (
    "set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to the cluster's token "
    "(`ray get-auth-token` prints it there)"
)


def has_token() -> bool:
    """Whether Ray would find a token: in RAY_AUTH_TOKEN, in the file RAY_AUTH_TOKEN_PATH, or in ~/.ray/auth_token."""
    path = os.environ.get("RAY_AUTH_TOKEN_PATH")
    file = Path(path or os.path.expanduser("~/.ray/auth_token"))  # a user without a home has none
    try:
        return bool(os.environ.get(TOKEN)) or file.is_file()
    except PermissionError:  # the folder is another user's, and so is what lies in it
        return False


def guard_ray(joins: bool) -> None:
    """Sets those of the variables that are unset; call it before Ray is imported.

    Args:
      joins: whether a cluster is joined, rather than Ray started by this process.

    Raises:
      ConfigError: Ray is to be started, but it has been imported while the variables were unset.
    """
    if joins:
        os.environ.setdefault(MODE, "token" if has_token() else "disabled")
        return
    require(
        MODE in os.environ or "ray" not in sys.modules,
        "Ray was imported before its authentication was configured; call learner.ray_backend.auth.guard_ray first, "
        f"or set {MODE} and {TOKEN}",
    )
    os.environ.setdefault(REMOTE, "0")
    if os.environ.setdefault(MODE, "token") == "token" and not has_token():
        os.environ[TOKEN] = secrets.token_hex(32)
