"""The command `shoal`: parses arguments, runs a command, and turns expected errors into one sentence and an exit code.

Options are dataclasses in `deploy.options`. The command NAME is run by `deploy.commands.NAME`, which is imported only
when it runs, so that help and refused arguments need not wait for Ray, torch or MLflow.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import importlib
import operator
import os
import signal
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, cast, get_args

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is imported: with more, processes compete for cores

import tyro  # noqa: E402

from actors.service.fault_policy import RunFailed, first_line  # noqa: E402
from actors.storage.full_disk import is_disk_full  # noqa: E402
from deploy.console.streams import outlive_streams, prepare_streams  # noqa: E402
from deploy.options.results import Dashboard, Evaluate, Export, Relocate, Report, Stress, Watch  # noqa: E402
from deploy.options.training import Chaos, Resume, Search, Submit, Sweep, Train, ray_address  # noqa: E402
from learner.config import RunConfig, from_dict  # noqa: E402
from learner.presets import TrainingPreset, preset_config  # noqa: E402
from learner.ray_backend.auth import guard_ray  # noqa: E402
from sim_core.checks import ConfigError, require, require_packages  # noqa: E402

FAILED = 1
BAD_INPUT = 2
SIGNALLED = 128
"""Exit code after a signal, plus its number."""
Command = (
    Train
    | Sweep
    | Search
    | Report
    | Resume
    | Evaluate
    | Stress
    | Watch
    | Chaos
    | Export
    | Submit
    | Dashboard
    | Relocate
)
COMMANDS: dict[type[Command], str] = {
    Train: "train",
    Sweep: "sweep",
    Search: "search",
    Report: "report",
    Resume: "resume",
    Evaluate: "evaluate",
    Stress: "stress",
    Watch: "watch",
    Chaos: "chaos",
    Export: "export",
    Submit: "submit",
    Dashboard: "dashboard",
    Relocate: "relocate",
}
"""Every command's name, by its options, in the order of the help text."""
CONFIGS = Path(__file__).parent / "configs"
"""Configs that are part of shoal."""
OUTLIVES_TERMINAL = (Train, Sweep, Search, Resume, Chaos)
"""Commands whose work lies in a run's folder: they go on where nobody takes what they print."""
JOBS = ("train", "sweep")
"""Commands that `shoal submit` can run."""
BAD_PATH_ERRORS = (errno.ENAMETOOLONG, errno.EILSEQ, errno.ELOOP)
"""Errors of paths that no file can have. A command may meet them wherever it first opens the path."""

FORBIDDEN_ERRORS = (errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors of paths that are another user's, or on a disk that takes nothing."""


def config_file(named: Path) -> Path:
    """The file that `--config` names: a path, or the name of a config that is part of shoal, such as `cartpole`."""
    own = CONFIGS / f"{named.name}.toml"
    return own if named.parts == (named.name,) and own.is_file() and not named.is_file() else named


def read_config_file(named: Path) -> RunConfig:
    """Reads a config from the TOML file that `--config` names.

    Raises:
      ConfigError: the file cannot be read, is not valid TOML, or holds an unknown key or an impossible value.
    """
    try:
        values = tomllib.loads(config_file(named).read_text("utf-8-sig"))  # Windows' editors write a mark first
    except (OSError, UnicodeDecodeError) as error:
        known = ", ".join(sorted(path.stem for path in CONFIGS.glob("*.toml")))
        raise ConfigError(f"--config {named} cannot be read: {error}; configs of shoal: {known}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"--config {named} is no valid TOML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"--config {named} is nested too deeply; settings are plain values and lists") from error
    return from_dict(values)


def _value_of(flag: str, arguments: Sequence[str]) -> str | None:
    """The value of `flag`, for flags that are needed before the rest is parsed."""
    for i, argument in enumerate(arguments):
        if argument == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{flag}="):
            return argument.removeprefix(f"{flag}=")
    return None


def _train_defaults(arguments: Sequence[str]) -> Train:
    """The defaults of `shoal train`, or the values of its `--config` or `--preset`.

    Raises:
      ConfigError: the config file is refused, or a preset is named, too.
    """
    path, preset, method = (_value_of(flag, arguments) for flag in ("--config", "--preset", "--method"))
    if path is not None:
        require(preset is None, "--config and --preset both give all settings; leave one of them out")
        return Train(config=Path(path), run=read_config_file(Path(path)))
    if preset in get_args(TrainingPreset):  # else tyro tells the choices
        return Train(run=preset_config(cast(TrainingPreset, preset), method or "sensor"))
    return Train()


def parse(arguments: Sequence[str]) -> Command:
    """Parses a command line, without the word `shoal`.

    Raises:
      ConfigError: a value is impossible.
      SystemExit: help was asked for (0), or a flag is unknown or malformed (2, after a message).
    """
    arguments, job = _split_job(arguments)
    subcommands = [tyro.conf.subcommand(name) for name in COMMANDS.values()]
    if arguments[:1] == ["train"]:  # only then: making a config loads its method with all kernels
        subcommands[0] = tyro.conf.subcommand("train", default=_train_defaults(arguments))
    union: Any = functools.reduce(operator.or_, map(_annotated, COMMANDS, subcommands))
    command: Command = tyro.cli(
        union,
        prog="shoal",
        args=list(arguments),
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff),
        description="Teach one robot to move with its swarm.",
    )
    if isinstance(command, Submit):
        require(bool(job), f"`shoal submit` needs a command to run: {' or '.join(JOBS)}, with its arguments")
        return dataclasses.replace(command, arguments=tuple(job), job=cast("Train | Sweep", parse(job)))
    return command


def _annotated(options: type[Command], subcommand: Any) -> Any:
    return Annotated[options, subcommand]


def _split_job(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Splits the arguments of `shoal submit` into its own and its job's; other commands have no job."""
    words = list(arguments)
    begin = next((i for i, word in enumerate(words) if word in JOBS), len(words)) if words[:1] == ["submit"] else None
    return words[:begin], [] if begin is None else words[begin:]


def _joins_cluster(command: Command) -> bool:
    """Whether the command connects to a Ray cluster that is running already."""
    if isinstance(command, Train | Sweep | Search):
        return command.launch.ray_address() is not None
    return isinstance(command, Submit) or (
        isinstance(command, Resume | Evaluate | Stress) and ray_address(command.address) is not None
    )


def execute(command: Command) -> int:
    """Runs a command; returns its exit code."""
    if isinstance(command, OUTLIVES_TERMINAL):
        outlive_streams()
    guard_ray(_joins_cluster(command))  # sets what Ray reads when it is imported
    if isinstance(command, Dashboard):
        require_packages("shoal dashboard", "dashboard", "plotly")
    module = importlib.import_module(f"deploy.commands.{COMMANDS[type(command)]}")
    return int(module.run(command))


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `shoal`; returns the exit code."""
    prepare_streams()
    try:
        words = list(sys.argv[1:] if arguments is None else arguments)
        command = parse(words)
        if isinstance(command, Train) and command.supervise:
            _supervise(command, words)
        return execute(command)
    except ConfigError as error:
        print(f"shoal: {' '.join(str(error).splitlines())}", file=sys.stderr)  # names may hold line breaks
        return BAD_INPUT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except RunFailed as error:
        print(f"shoal: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt as error:
        print("shoal: interrupted", file=sys.stderr)
        return SIGNALLED + getattr(error, "signal", signal.SIGINT)
    except Exception as error:
        sentence, code = _explained(error)
        if sentence is None:
            raise
        print(f"shoal: {sentence}", file=sys.stderr)
        return code


def _supervise(command: Train, words: list[str]) -> NoReturn:
    """Makes this process the supervisor of the run that `words` start."""
    from deploy.runs.folders import stamped_name
    from deploy.supervisor import take_over

    name = command.launch.name or stamped_name(command.run)
    named = [] if command.launch.name else ["--name", name]
    take_over(command.launch.runs_dir / name, [word for word in words if word != "--supervise"] + named)


def _explained(error: Exception) -> tuple[str | None, int]:
    """One sentence about an error of the disk or of a path, and the exit code; no sentence about any other error."""
    if is_disk_full(error):
        line = f"the disk is full ({first_line(error)}); free some space, then give the command again"
        return f"{line}, or `shoal resume` for a run that has begun", FAILED
    if isinstance(error, OSError) and error.errno in FORBIDDEN_ERRORS:
        return f"{error.filename} may not be used by you ({error.strerror}); ask its owner", BAD_INPUT
    if isinstance(error, OSError) and error.errno in BAD_PATH_ERRORS:
        name = str(error.filename)
        short = name if len(name) <= 60 else f"{name[:60]}..."
        return f"{short!r} cannot name a file ({error.strerror}); choose another name", BAD_INPUT
    return None, FAILED
