"""The command line: every command has its module, and light commands import no heavy package."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import dashboards
import deploy.commands
from deploy.cli import COMMANDS, Command

TABLE = Path(dashboards.__file__).parent / "results" / "thesis" / "results.csv"
HEAVY = ("torch", "ray", "mlflow", "zarr", "matplotlib", "imageio_ffmpeg")
PROBE = f"""
import sys
from deploy.cli import main
try:
    code = main(sys.argv[1:])
except SystemExit as stop:
    code = stop.code
print("imported:", *({{*{HEAVY!r}}} & sys.modules.keys()))
sys.exit(code)
"""


def test_every_command_has_a_name_and_a_module():
    assert set(COMMANDS) == set(get_args(Command))
    modules = {path.stem for path in Path(deploy.commands.__file__).parent.glob("*.py")} - {"__init__"}
    assert sorted(COMMANDS.values()) == sorted(modules)


@pytest.mark.parametrize(("options", "name"), COMMANDS.items(), ids=COMMANDS.values())
def test_a_command_is_run_with_its_options_and_returns_an_exit_code(options: type, name: str):
    run = importlib.import_module(f"deploy.commands.{name}").run
    assert list(inspect.signature(run).parameters) == ["command"]
    assert get_type_hints(run) == {"command": options, "return": int}


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["train", "--help"], ["dashboard", str(TABLE)], ["train", "--robots", "1"], ["dashboard", "none.csv"]],
    ids=lambda arguments: arguments[0] + arguments[-1][-6:],
)
def test_help_refusals_and_a_table_alone_import_nothing_heavy(arguments: list[str], tmp_path: Path):
    out = ["--out", str(tmp_path / "d.html")] if arguments[0] == "dashboard" else []
    done = subprocess.run([sys.executable, "-c", PROBE, *arguments, *out], capture_output=True, text=True, check=False)
    assert done.returncode == (0 if "--help" in arguments or str(TABLE) in arguments else 2), done.stderr
    assert done.stdout.splitlines()[-1] == "imported:"
    assert not out or (tmp_path / "d.html").exists() == (done.returncode == 0)
