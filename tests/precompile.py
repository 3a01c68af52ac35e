"""Compiles the kernels that most tests need, so that each of pytest's processes finds them in the cache.

It needs none of the packages that tests add, so that it runs while those are being installed.

python -m tests.precompile
"""

import dataclasses
import itertools
import tempfile
from pathlib import Path

from tests.small_run import OPTIONS, SMALL, train


def main() -> None:
    """Trains a small run of every method, with plain and with prioritised replay, and one of another environment."""
    runs = [dataclasses.replace(SMALL, env_id="CartPole-v1")]
    for method, options in itertools.product(("sensor", "in", "out"), ({}, OPTIONS)):
        runs.append(dataclasses.replace(SMALL, world=dataclasses.replace(SMALL.world, method=method), **options))
    for run in runs:
        with tempfile.TemporaryDirectory() as folder:
            train(run, Path(folder))


if __name__ == "__main__":
    main()
