"""Builds self-contained HTML documents from the files in `dashboards/web`; they load nothing from elsewhere."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Sequence
from importlib import resources
from typing import Any

OFFLINE = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:"
"""Content security policy of a page opened from disk: it may connect to nothing."""
SERVED = f"{OFFLINE}; connect-src 'self'"
"""Content security policy of a served page: it may connect to its own server alone."""
PLAYER_CSS = ("base.css", "player.css")
PLAYER_JS = ("dom.js", "inflate.js", "player.js", "draw.js", "orca.js")


def asset(name: str) -> str:
    """The text of a file in `dashboards/web`."""
    return resources.files("dashboards").joinpath("web", name).read_text("utf-8")


def assets(*names: str) -> str:
    """The texts of several files, concatenated."""
    return "".join(asset(name) for name in names)


def document(title: str, policy: str, css: Sequence[str], body: str, **fields: str) -> str:
    """An HTML document.

    Args:
      title: plain text; it is escaped.
      policy: content security policy.
      css: files of its style.
      body: file of its body, a template.
      **fields: HTML of the body's fields, in addition to `title`.
    """
    escaped = html.escape(title)
    content = _filled(body, title=escaped, **fields)
    return _filled("document.html", title=escaped, policy=html.escape(policy), css=assets(*css), body=content)


def _filled(template: str, **fields: str) -> str:
    """The file `template` with every `{{name}}` replaced by its field; the fields themselves are not searched."""
    return re.sub(r"\{\{([a-z]+)\}\}", lambda match: fields[match[1]], asset(template))


def embedded(values: Any) -> str:
    """JSON, escaped for a script element."""
    return to_json(values).replace("<", "\\u003c")


def to_json(values: Any) -> str:
    """Compact JSON.

    Raises:
      ValueError: a number is not finite, which JSON cannot express.
    """
    return json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def packed(data: bytes) -> str:
    """Bytes in the form that `inflate.js` reads: compressed by zlib, then base64."""
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")
