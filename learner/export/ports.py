"""The inputs and outputs of exported policies: names, shapes, units and what they mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from actors.rollout.vector_env import EnvShape

FRAME = (
    "positions are those of other robots and of goals less the robot's own; x and y along the axes of the world, "
    "the same for positions, goals and velocities, whichever way the robot faces"
)


class Port(NamedTuple):
    """One input or output of an exported policy; a size that is a name may be any number."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]
    unit: str
    meaning: str

    def described(self) -> dict[str, Any]:
        """As plain values for JSON."""
        return {**self._asdict(), "shape": list(self.shape)}


def bare_inputs(shape: EnvShape, names: Sequence[str] = ()) -> list[Port]:
    """What a bare policy takes; `names` are those of an observation's elements, where they are known."""
    space = shape.observation_space
    assert space.dtype is not None
    dtype = np.dtype(space.dtype).name
    meaning = "as the environment gives it" + (f": {', '.join(names)}" if names else "")
    return [Port("observation", dtype, ("batch", *space.shape), "", meaning)]


def bare_outputs(shape: EnvShape) -> list[Port]:
    """What a bare policy gives, in its order."""
    return [
        Port("action", "int64", ("batch",), "", "action of the highest value"),
        Port("action_values", "float32", ("batch", shape.num_actions), "", "discounted reward promised by each action"),
    ]
