"""The settings that a search varies: texts such as `learning_rate=1e-4..1e-2:log` to ranges and choices."""

from __future__ import annotations

import math
import re
import tomllib
import typing
from typing import Any, NamedTuple

from learner.config import RunConfig
from learner.sweep.grid import SET_BY_GRID, assigned
from sim_core.checks import ConfigError, require
from sim_core.config import WorldConfig

FORMS = "NAME=LOW..HIGH, NAME=LOW..HIGH:log or NAME=A,B,C"
NUMBER = r"[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
RANGE = re.compile(rf"({NUMBER})\.\.({NUMBER})(:log)?")


class Range(NamedTuple):
    """Numbers from `low` to `high`, both included; whole ones if `whole`, drawn on a logarithmic scale if `log`."""

    name: str
    low: float
    high: float
    whole: bool
    log: bool

    @property
    def ends(self) -> tuple[float, float]:
        """The two ends."""
        return self.low, self.high


class Choices(NamedTuple):
    """Values without an order, as texts."""

    name: str
    values: tuple[str, ...]

    @property
    def ends(self) -> tuple[str, ...]:
        """All values."""
        return self.values


Dimension = Range | Choices
Value = float | int | str
"""A value of a dimension: a number, or the text of a choice."""


def assignment(name: str, value: Value) -> str:
    """The text NAME=VALUE of `shoal sweep --set`."""
    return f"{name}={value if isinstance(value, str) else repr(value)}"


def parse_space(texts: tuple[str, ...]) -> tuple[Dimension, ...]:
    """The dimensions that texts name, none for no texts.

    Raises:
      ConfigError: a text has none of the forms, names an unknown setting or one that a search sets itself, is empty, or
        does not fit the setting's type; or a setting is named twice.
    """
    found = tuple(map(_dimension, texts))
    names = [dimension.name for dimension in found]
    twice = [name for name in names if names.count(name) > 1]
    require(not twice, f"space varies {', '.join(twice[:1])} twice; name each setting once")
    return found


def _dimension(text: str) -> Dimension:
    name, sign, values = text.partition("=")
    require(bool(sign) and bool(name) and bool(values.strip()), f"space takes {FORMS}, not {text!r}")
    kind = _type_of(name)
    match = RANGE.fullmatch(values)
    return _range(text, name, kind, match) if match else _choices(text, name, values)


def _type_of(name: str) -> Any:
    """The type of a setting.

    Raises:
      ConfigError: there is no such setting, or a search sets it itself.
    """
    owner = next((each for each in (RunConfig, WorldConfig) if name in each.__dataclass_fields__), None)
    require(
        owner is not None and name not in SET_BY_GRID,
        f"space cannot vary {name!r}; `shoal train --help` lists the settings, and setups, seeds and the length of the "
        "training have options of their own",
    )
    return typing.get_type_hints(owner)[name]


def _range(text: str, name: str, kind: Any, match: re.Match[str]) -> Range:
    require(kind in (int, float), f"space {text!r}: {name} is no number; list its values, as in {name}=A,B")
    low, high, log = float(match[1]), float(match[2]), bool(match[3])
    require(low < high, f"space {text!r} is empty: its first end must be below its second")
    require(not log or low > 0, f"space {text!r}: a logarithmic range must begin above 0")
    require(math.isfinite(low) and math.isfinite(high), f"space {text!r}: its ends must be finite")
    if kind is float:
        return Range(name, low, high, False, log)
    require(low.is_integer() and high.is_integer(), f"space {text!r}: {name} is a whole number, and so are its ends")
    return Range(name, int(low), int(high), True, log)


def _choices(text: str, name: str, values: str) -> Choices:
    words = _words(values)
    require(len(words) > 1, f"space {text!r} has one value only; write {FORMS}, or --set {text} for a fixed one")
    require(len(set(words)) == len(words), f"space {text!r} names a value twice")
    return Choices(name, words)


def _words(values: str) -> tuple[str, ...]:
    """The values between commas, where brackets and quotes may hold commas of their own."""
    try:
        found = tomllib.loads(f"value = [{values}]")["value"]
    except tomllib.TOMLDecodeError:
        return tuple(word.strip() for word in values.split(","))
    return tuple(_text(value) for value in found)


def _text(value: Any) -> str:
    """A TOML value as the text that `--set` reads."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(_text, value))}]" if isinstance(value, list) else str(value)


def check_values(dimensions: tuple[Dimension, ...], fixed: tuple[str, ...]) -> None:
    """Raises ConfigError where `fixed`, the overrides of every trial, set what the search varies."""
    varied = {dimension.name for dimension in dimensions}
    for name in assigned(fixed):
        if name in varied:
            raise ConfigError(f"--set and --space both name {name}; leave it out of one")
