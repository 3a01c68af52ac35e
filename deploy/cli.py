"""The command `shoal`: parses arguments, calls a command, and turns errors into one sentence and exit code 2."""

from __future__ import annotations

import dataclasses
import errno
import os
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast, get_args

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy: one thread a process, or processes fight for cores

import tyro  # noqa: E402

from actors.service.fault_policy import RunFailed  # noqa: E402
from deploy.options.results import Dashboard, Evaluate, Export, Report, Watch  # noqa: E402
from deploy.options.training import Chaos, Resume, Submit, Sweep, Train, ray_address  # noqa: E402
from learner.config import RunConfig, from_dict  # noqa: E402
from learner.presets import PresetName, preset_config  # noqa: E402
from learner.ray_backend.auth import guard_ray  # noqa: E402
from sim_core.checks import ConfigError, require, require_packages  # noqa: E402

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130
Command = Train | Sweep | Report | Resume | Evaluate | Watch | Dashboard | Chaos | Export | Submit
JOBS = ("train", "sweep")
"""What `shoal submit` runs."""
BAD_NAMES = (errno.ENAMETOOLONG, errno.EILSEQ, errno.ELOOP)
"""Errors of paths that no file can have, wherever a command first looks at them."""


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


def _value_of(flag: str, arguments: Sequence[str]) -> str | None:
    """What follows `flag`, for flags that are needed before the rest is parsed."""
    for i, argument in enumerate(arguments):
        if argument == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{flag}="):
            return argument.removeprefix(f"{flag}=")
    return None


def _train_defaults(arguments: Sequence[str]) -> Train:
    """What `shoal train` starts from: the defaults, or the values of a `--config` or a `--preset`.

    Raises:
      ConfigError: the config's file cannot be read or holds what cannot work, or a preset is named beside it.
    """
    path, preset, method = (_value_of(flag, arguments) for flag in ("--config", "--preset", "--method"))
    if path is not None:
        require(preset is None, "--config and --preset both give all settings; leave one of them out")
        return Train(config=Path(path), run=read_config_file(Path(path)))
    if preset in get_args(PresetName):  # else tyro tells the choices
        return Train(run=preset_config(cast(PresetName, preset), method or "sensor"))
    return Train()


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments name.

    Raises:
      ConfigError: a value cannot work.
      SystemExit: help was asked for (0), or a flag is unknown or malformed (2, after a message).
    """
    arguments, job = _without_job(arguments)
    default = _train_defaults(arguments) if arguments and arguments[0] == "train" else Train()
    commands: Any = (
        Annotated[Train, tyro.conf.subcommand("train", default=default)]
        | Annotated[Sweep, tyro.conf.subcommand("sweep")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Resume, tyro.conf.subcommand("resume")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Watch, tyro.conf.subcommand("watch")]
        | Annotated[Chaos, tyro.conf.subcommand("chaos")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Submit, tyro.conf.subcommand("submit")]
        | Annotated[Dashboard, tyro.conf.subcommand("dashboard")]
    )
    options = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
    command: Command = tyro.cli(
        commands,
        prog="shoal",
        args=list(arguments),
        config=options,
        description="Teach one robot to move with its swarm.",
    )
    if isinstance(command, Submit):
        require(bool(job), f"`shoal submit` needs a command to run: {' or '.join(JOBS)}, with its arguments")
        command = dataclasses.replace(command, command=tuple(job))
        parse(job)  # refuses here what the job would refuse
    return command


def _without_job(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments of `shoal submit` and, apart, the command that it is to run; of other commands all and none."""
    words = list(arguments)
    begin = next((i for i, word in enumerate(words) if word in JOBS), len(words)) if words[:1] == ["submit"] else None
    return words[:begin], [] if begin is None else words[begin:]


def _joins_cluster(command: Command) -> bool:
    """Whether the command speaks to a Ray cluster that is there already."""
    if isinstance(command, Train | Sweep):
        return command.launch.ray_address() is not None
    return isinstance(command, Submit) or (
        isinstance(command, Resume | Evaluate) and ray_address(command.address) is not None
    )


def execute(command: Command) -> int:
    """Runs a command; returns its exit code. Imports are late: help must not wait for Ray and MLflow."""
    guard_ray(_joins_cluster(command))  # which Ray reads when it is imported
    if isinstance(command, Train | Resume):
        from deploy.commands import train as training

        return training.train(command) if isinstance(command, Train) else training.resume(command)
    if isinstance(command, Sweep):
        from deploy.commands.sweep import sweep

        return sweep(command)
    if isinstance(command, Submit):
        from deploy.commands.submit import submit

        return submit(command, cast("Train | Sweep", parse(command.command)))
    if isinstance(command, Report):
        from deploy.commands.report import report

        return report(command)
    if isinstance(command, Chaos):
        from deploy.chaos.run import chaos

        return chaos(command)
    if isinstance(command, Export):
        from deploy.commands.export import export

        return export(command)
    if isinstance(command, Dashboard):
        require_packages("shoal dashboard", "dashboard", "plotly")
        from deploy.commands.dashboard import dashboard

        return dashboard(command)
    from deploy.commands import evaluate as playing

    return playing.evaluate(command) if isinstance(command, Evaluate) else playing.watch(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `shoal`; returns the exit code."""
    try:
        return execute(parse(sys.argv[1:] if arguments is None else arguments))
    except ConfigError as error:
        print(f"shoal: {' '.join(str(error).splitlines())}", file=sys.stderr)  # names may hold line breaks
        return BAD_INPUT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:
        if error.errno not in BAD_NAMES:
            raise
        name = str(error.filename)
        short = name if len(name) <= 60 else f"{name[:60]}..."
        print(f"shoal: {short!r} cannot name a file ({error.strerror}); choose another name", file=sys.stderr)
        return BAD_INPUT
    except RunFailed as error:
        print(f"shoal: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("shoal: interrupted", file=sys.stderr)
        return INTERRUPTED
