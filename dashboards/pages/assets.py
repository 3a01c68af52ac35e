"""Web pages made of the files in `dashboards/web`: one self-contained document, nothing fetched from elsewhere."""

from __future__ import annotations

import base64
import json
import re
import zlib
from importlib import resources
from typing import Any

OFFLINE = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:"
"""Content security policy of a page that opens from disk: it can reach nothing."""
SERVED = f"{OFFLINE}; connect-src 'self'"
"""That of a page that asks the server it came from for newer data."""
PLAYER_CSS = ("base.css", "player.css")
PLAYER_JS = ("inflate.js", "player.js", "draw.js", "orca.js")


def asset(name: str) -> str:
    """The text of a file in `dashboards/web`."""
    return resources.files("dashboards").joinpath("web", name).read_text("utf-8")


def assets(*names: str) -> str:
    """Several files, one after the other."""
    return "".join(asset(name) for name in names)


def fill(template: str, fields: dict[str, str]) -> str:
    """The file `template` with every `{{name}}` replaced, once: what is put in is not searched again."""
    return re.sub(r"\{\{([a-z-]+)\}\}", lambda match: fields[match[1]], asset(template))


def embedded(values: Any) -> str:
    """JSON that may stand inside a script element."""
    return to_json(values).replace("<", "\\u003c")


def to_json(values: Any) -> str:
    """Compact JSON; what JSON cannot say, such as NaN, is refused."""
    return json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def packed(data: bytes) -> str:
    """Bytes as `inflate.js` takes them: zlib, then base64."""
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")
