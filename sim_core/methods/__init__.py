"""The state representations, by name; adding one touches its own module and this table."""

from __future__ import annotations

from sim_core.config import WorldConfig
from sim_core.methods.base import Method
from sim_core.methods.m_in import InsideMethod
from sim_core.methods.m_out import OutsideMethod
from sim_core.methods.m_sensor import SensorMethod

METHODS: dict[str, type[Method]] = {"sensor": SensorMethod, "in": InsideMethod, "out": OutsideMethod}


def make_method(config: WorldConfig) -> Method:
    """The method that `config.method` names."""
    return METHODS[config.method](config)
