"""That every benchmark starts: a name that another one lost would else be missed only when somebody runs it."""

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("[!_]*.py")))
def test_a_benchmark_finds_what_it_imports(name):
    importlib.import_module(f"tests.benchmarks.{name}")
