"""The command `shoal`: parses arguments, calls a command, and turns errors into one sentence and exit code 2."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy: one thread a process, or processes fight for cores

import tyro  # noqa: E402

from deploy.options import Command, Evaluate, Report, Resume, Sweep, Train, Watch  # noqa: E402
from learner.config import RunConfig, from_dict  # noqa: E402
from sim_core.checks import ConfigError  # noqa: E402

BAD_INPUT = 2
INTERRUPTED = 130


def read_config_file(path: Path) -> RunConfig:
    """The config of a TOML file.

    Raises:
      ConfigError: the file cannot be read, is no TOML, or holds an unknown key or a value that cannot work.
    """
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path} cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"--config {path} is no valid TOML: {error}") from error
    return from_dict(values)


def _config_argument(arguments: Sequence[str]) -> Path | None:
    """The file after `--config`, which is needed before the rest is parsed: its values are the defaults."""
    for i, argument in enumerate(arguments):
        if argument == "--config" and i + 1 < len(arguments):
            return Path(arguments[i + 1])
        if argument.startswith("--config="):
            return Path(argument.removeprefix("--config="))
    return None


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments name.

    Raises:
      ConfigError: a value cannot work.
      SystemExit: help was asked for (0), or a flag is unknown or malformed (2, after a message).
    """
    path = _config_argument(arguments)
    default = Train(config=path, run=read_config_file(path)) if path else Train()
    commands: Any = (
        Annotated[Train, tyro.conf.subcommand("train", default=default)]
        | Annotated[Sweep, tyro.conf.subcommand("sweep")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Resume, tyro.conf.subcommand("resume")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Watch, tyro.conf.subcommand("watch")]
    )
    options = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
    command: Command = tyro.cli(
        commands,
        prog="shoal",
        args=list(arguments),
        config=options,
        description="Teach one robot to move with its swarm: train, sweep, report, resume, evaluate and watch.",
    )
    return command


def execute(command: Command) -> int:
    """Runs a command; returns its exit code. Imports are late: help must not wait for Ray and MLflow."""
    if isinstance(command, Train | Resume):
        from deploy import training

        return training.train(command) if isinstance(command, Train) else training.resume(command)
    if isinstance(command, Sweep):
        from deploy.sweep import sweep

        return sweep(command)
    if isinstance(command, Report):
        from deploy.report import report

        return report(command)
    from deploy import playing

    return playing.evaluate(command) if isinstance(command, Evaluate) else playing.watch(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `shoal`; returns the exit code."""
    try:
        return execute(parse(sys.argv[1:] if arguments is None else arguments))
    except ConfigError as error:
        print(f"shoal: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("shoal: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
