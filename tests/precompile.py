"""Compiles the kernels that most tests need, so that each of pytest's processes finds them in the cache.

python -m tests.precompile
"""

import dataclasses
import itertools
import tempfile
from pathlib import Path

from tests.integration.conftest import SMALL
from tests.integration.test_process_run import OPTIONS, train


def main() -> None:
    """Trains a small run of every method, with plain and with prioritised replay."""
    for method, options in itertools.product(("sensor", "in", "out"), ({}, OPTIONS)):
        world = dataclasses.replace(SMALL.world, method=method)
        with tempfile.TemporaryDirectory() as folder:
            train(dataclasses.replace(SMALL, world=world, **options), Path(folder))


if __name__ == "__main__":
    main()
