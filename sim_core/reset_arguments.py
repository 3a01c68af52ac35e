"""The arguments of `reset` of Gymnasium's environments: seeds and options, read as Gymnasium's own environments do."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

RESET_MASK = "reset_mask"
"""The option that `reset` of Gymnasium's vector environments has: the environments to restart, `[num_envs]` bool."""


def env_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """One seed an environment, as Gymnasium's own vector environments read `seed`; numpy's integers count as ints.

    Args:
      seed: None for no seed, s for s + i, or a sequence with one seed or None an environment.
      num_envs: number of environments.

    Raises:
      ValueError: there is not one seed an environment, or one is negative or no whole number.
    """
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        seed = [int(seed) + i for i in range(num_envs)]
    seeds = list(seed)
    if len(seeds) != num_envs:
        raise ValueError(f"seed must name {num_envs} whole numbers or None, one an environment, not {seed!r}")
    return [None if value is None else whole_seed(value) for value in seeds]


def whole_seed(seed: Any) -> int:
    """A seed as an int.

    Raises:
      ValueError: it is negative or no whole number.
    """
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed must be a whole number >= 0, not {seed!r}")
    return int(seed)


def reset_mask(options: dict[str, Any] | None, num_envs: int) -> NDArray[np.bool_] | None:
    """The environments that `reset` restarts, `[num_envs]` bool; None for all.

    Raises:
      ValueError: an option is unknown, or the mask is no array of `[num_envs]` bool with a True.
    """
    check_options(options, (RESET_MASK,))
    mask = (options or {}).get(RESET_MASK)
    if mask is None:
        return None
    fits = isinstance(mask, np.ndarray) and mask.shape == (num_envs,) and mask.dtype == np.bool_
    if not fits or not mask.any():
        raise ValueError(f"{RESET_MASK} must be a numpy array of {num_envs} bool with at least one True, not {mask!r}")
    return cast("NDArray[np.bool_]", mask)


def check_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    """Raises ValueError if `options` of a reset holds any but the known ones."""
    unknown = [name for name in options or {} if name not in known]
    if unknown:
        raise ValueError(f"reset has no option {unknown[0]!r}; it has: {', '.join(known) or 'none'}")
