"""Methods: state representations of the learning robot, each one class in a module of its own.

A new one is a module here and its line in `sim_core.plugins.METHODS`, or a user's own file.
"""

from __future__ import annotations

from sim_core.config import WorldConfig
from sim_core.methods.base import CheckedMethod, Method
from sim_core.plugins import METHODS


def make_method(config: WorldConfig) -> Method:
    """The method that `config.method` names; a user's own is checked in every step."""
    if config.source(METHODS):
        return CheckedMethod(config)
    method: Method = config.method_class(config)
    return method
