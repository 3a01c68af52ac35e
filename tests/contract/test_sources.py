"""What no source of ours may do: read pickle, or hand anything to a shell."""

import ast
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


def test_there_are_sources():
    assert len(SOURCES) > 80
