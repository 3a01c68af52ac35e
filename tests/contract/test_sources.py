"""What no source may do (read pickle, use a shell, print a name as rich's markup), and what is committed."""

import ast
import subprocess
from pathlib import Path

import pytest

import deploy

ROOT = Path(deploy.__file__).parent.parent
PACKAGES = ("sim_core", "actors", "learner", "dashboards", "deploy")
SOURCES = [path for name in PACKAGES for path in (ROOT / name).rglob("*.py") if "__pycache__" not in path.parts]
READERS = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
SHELLS = {"os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"}
RUNNERS = {"run", "Popen", "call", "check_call", "check_output"}


def calls_of(tree):
    """(call, dotted name) of every call."""
    return [(node, ast.unparse(node.func)) for node in ast.walk(tree) if isinstance(node, ast.Call)]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_pickle_and_no_shell(path):
    tree = ast.parse(path.read_text("utf-8"))
    imported = {
        alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
    }
    imported |= {str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not imported & READERS
    for call, name in calls_of(tree):
        keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
        assert name not in SHELLS | {"eval", "exec"}, name
        assert name != "torch.load" or keywords.get("weights_only") == "True", name
        assert name not in ("np.load", "numpy.load") or keywords.get("allow_pickle", "False") == "False", name
        if name.startswith("subprocess.") and name.split(".")[1] in RUNNERS:
            assert keywords.get("shell", "False") == "False"
            assert not isinstance(call.args[0], ast.Constant | ast.JoinedStr), "a list of words, not a line for a shell"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_consoles_show_text_as_it_is(path):
    """Every console is a `plain_console`, and no text is made from markup, which rich always reads in a status."""
    calls = calls_of(ast.parse(path.read_text("utf-8")))
    names = {name for _, name in calls}
    made_here = {"Console"} if path == ROOT / "deploy" / "console" / "terminal.py" else set()
    read_markup = {name for name in names if name.split(".")[-1] in ("Console", "from_markup", "get_console")}
    assert read_markup == made_here
    statuses = [call.args for call, name in calls if name.endswith(".status")]
    assert all(isinstance(each, ast.Constant) for arguments in statuses for each in arguments)


def test_there_are_sources():
    assert len(SOURCES) > 80


def test_the_top_level_holds_what_it_shall_and_nothing_that_a_run_leaves():
    words = ["git", "-C", str(ROOT), "ls-files", "--cached"]
    found = {line.split("/")[0] for line in subprocess.run(words, capture_output=True, text=True).stdout.splitlines()}
    if not found:
        pytest.skip("the sources are no git checkout")
    folders = {"sim_core", "actors", "learner", "deploy", "dashboards", "tests"}
    files = {"pyproject.toml", "README.md", "CHANGELOG.md", "Makefile"}
    assert {name for name in found if not name.startswith(".")} == folders | files
