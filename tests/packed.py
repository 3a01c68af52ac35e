"""Plain conversions between packed and unpacked transitions."""

import numpy as np
from gymnasium.spaces import Box

from actors.service.messages import transition_dtype
from actors.service.packing import Packed, packed_dtype


def pack(transitions, next_row=None):
    """Packs transitions; each gets a frame, except where `next_row` `[count]` gives the distance to a row."""
    rows = np.zeros(len(transitions), packed_dtype(transitions.dtype))
    for name in ("reward", "discount", "action", "observation"):
        rows[name] = transitions[name]
    ahead = np.zeros(len(rows), np.int32) if next_row is None else np.asarray(next_row, np.int32)
    to_frame = ahead <= 0
    rows["next_row"] = np.where(to_frame, 1 - np.cumsum(to_frame), ahead)
    return Packed(rows, transitions["next_observation"][to_frame])


def pack_as_collected(transitions, envs=64, n_step=3):
    """Packs transitions as a rollout worker does while no episode ends; ignores most next observations."""
    ahead = np.full(len(transitions), envs * n_step)
    ahead[-envs * n_step :] = 0
    return pack(transitions, ahead)


def as_rows(columns):
    """Transitions `[count]` from their columns."""
    observation = columns["observation"]
    transitions = np.zeros(len(observation), transition_dtype(Box(-9, 9, observation.shape[1:], observation.dtype)))
    for name, column in columns.items():
        transitions[name] = column
    return transitions


def unpack(packed, dtype):
    """Unpacked transitions of `dtype`."""
    transitions = np.zeros(len(packed.rows), dtype)
    for name in ("reward", "discount", "action", "observation"):
        transitions[name] = packed.rows[name]
    for i, next_row in enumerate(packed.rows["next_row"].tolist()):
        source = packed.rows["observation"][i + next_row] if next_row > 0 else packed.frames[-next_row]
        transitions["next_observation"][i] = source
    return transitions
