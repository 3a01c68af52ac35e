"""`make bench`: prints every benchmark's tables; `make bench ARGS=simulator` those of one."""

import argparse
import importlib
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from learner.ray_backend.auth import guard_ray  # noqa: E402
from tests.benchmarks import simulator  # noqa: E402

BENCHMARKS = (
    "startup",
    "simulator",
    "replay",
    "learner",
    "service",
    "scaling",
    "profile",
    "export",
    "checkpoints",
    "user_methods",
    "foreign_envs",
    "senses",
    "shield",
    "unicycle",
    "learners",
)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"benchmarks to run, of {', '.join(BENCHMARKS)}; default: all")
    parser.add_argument("--sections", nargs="+", choices=simulator.SECTIONS, help="parts of `simulator`; default: all")
    parser.add_argument(
        "--rvo2", type=Path, action="append", default=[], metavar="PATH", help="a built rvo2_driver; may be repeated"
    )
    parser.add_argument(
        "--picture", action="store_true", help="`scaling` draws the picture of the model in this folder's README anew"
    )
    parser.add_argument("--against", type=Path, metavar="PATH", help="`startup`: another checkout to compare with")
    parser.add_argument(
        "--rounds", type=int, default=3, help="`startup`, `service`: how often everything runs; default: 3"
    )
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in BENCHMARKS:
            parser.error(f"no benchmark {name!r}; there are: {', '.join(BENCHMARKS)}")
    for path in options.rvo2:
        if not path.is_file():
            parser.error(f"--rvo2: there is no file {path}")
    if options.against is not None and not (options.against / "deploy" / "cli.py").is_file():
        parser.error(f"--against: there is no checkout in {options.against}")
    return options


def main() -> int:
    options = parse()
    guard_ray(joins=False)  # before a benchmark imports Ray
    for name in options.names or BENCHMARKS:
        if name == "simulator":
            simulator.main(options.sections, [path.resolve() for path in options.rvo2])
        elif name == "startup":
            importlib.import_module("tests.benchmarks.startup").main(options.against, options.rounds)
        elif name == "service":
            importlib.import_module("tests.benchmarks.service").main(options.rounds)
        elif name == "scaling":
            importlib.import_module("tests.benchmarks.scaling").main(options.picture)
        else:  # imported here, as their libraries take seconds that the simulator's processes need not wait
            importlib.import_module(f"tests.benchmarks.{name}").main()
    return 0


if __name__ == "__main__":
    sys.exit(main())
