"""The error for invalid settings, and a check of a config's fields against their annotations."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import math
import typing
from typing import Any, Literal

import numpy as np


class ConfigError(Exception):
    """An invalid setting. The message names the setting, its value and a fix."""


def require(condition: bool, message: str) -> None:
    """Raises ConfigError with `message` unless `condition` holds."""
    if not condition:
        raise ConfigError(message)


def require_packages(purpose: str, extra: str, *packages: str) -> None:
    """Refuses what needs an optional dependency that is not installed.

    Args:
      purpose: what needs the packages; the sentence begins with it.
      extra: the extra of shoal that installs them.
      packages: names under which they are imported.

    Raises:
      ConfigError: a package is missing.
    """
    for name in packages:
        found = importlib.util.find_spec(name) is not None
        require(found, f"{purpose} needs the package {name}: install it with `pip install 'shoal[{extra}]'`")


def check_fields(config: object) -> None:
    """Checks the bool, int, float, str and Literal fields of a config dataclass; it ignores fields of other types.

    Numpy's scalars become plain ones of Python, which JSON and hashes of configs know.

    Raises:
      ConfigError: a value has the wrong type, is not finite, or is none of its field's choices.
    """
    for field, wanted in _typed_fields(type(config)):  # type: ignore[arg-type]  # a class has a hash
        value = getattr(config, field.name)
        if isinstance(value, np.generic) and value.ndim == 0:
            value = value.item()
            object.__setattr__(config, field.name, value)
        if typing.get_origin(wanted) is Literal:
            choices = typing.get_args(wanted)
            known = isinstance(value, str) and value in choices
            require(known, f"{field.name} must be one of: {', '.join(choices)}; not {value!r}")
        elif wanted is int:
            whole = isinstance(value, int) and not isinstance(value, bool)
            require(whole, f"{field.name} must be a whole number, not {value!r}")
        elif wanted is float:
            require(_is_finite_number(value), f"{field.name} must be a finite number, not {value!r}")
        elif wanted in (bool, str):
            name = "true or false" if wanted is bool else "a string"
            require(isinstance(value, wanted), f"{field.name} must be {name}, not {value!r}")


@functools.cache
def _typed_fields(kind: Any) -> list[tuple[dataclasses.Field[Any], Any]]:
    hints = typing.get_type_hints(kind)  # evaluates every annotation, which takes milliseconds
    return [(field, hints[field.name]) for field in dataclasses.fields(kind)]


def _is_finite_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int beyond the range of float
        return False
