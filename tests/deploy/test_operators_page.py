"""The operator's page: its sizes follow from the benchmarks that it cites; its commands and files exist."""

import math
import re
import shlex

import pytest

from deploy.cli import parse
from tests.deploy.manifests import ROOT

PAGE = (ROOT / "deploy" / "README.md").read_text()
TEXT = " ".join(PAGE.split())
"""The page without line breaks."""
MEASURED = (ROOT / "tests" / "benchmarks" / "README.md").read_text()
CELLS_A_NODE = 8


def number(text: str) -> float:
    return float(text.replace(",", ""))


def benchmark(row: str, column: int) -> float:
    """A number in the benchmark tables: the first in this column of the first row with this text."""
    line = next(line for line in MEASURED.splitlines() if line.startswith("│") and row in line)
    return number(re.search(r"[\d,.]+", line.split("│")[column])[0])


def table(heading: str) -> list[list[str]]:
    """Cells of the page's table that begins with `heading`."""
    lines = PAGE.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading} |"))
    rows = []
    for line in lines[start + 2 :]:
        if not line:
            return rows
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    raise AssertionError(f"the table {heading} has no end")


@pytest.fixture(scope="module")
def model():
    """Measured env steps/s: a rollout worker, the simulator where its table was made, a full learner."""
    (full,) = re.findall(r"^\| 2 \| ([\d,]+) env steps/s \|", MEASURED, re.MULTILINE)
    (learner,) = re.findall(r"^\| bare learner, batch 256, one core \| \| ([\d,]+) ", MEASURED, re.MULTILINE)
    assert f"{learner} updates/s at batch 256" in TEXT
    (worker,) = re.findall(r"^\| 1 \| 0.25 \| ([\d,]+) \|", MEASURED, re.MULTILINE)
    (simulator,) = re.findall(r"the bare simulator made ([\d,]+) env steps/s", MEASURED)
    assert f"times {worker} / {simulator}," in TEXT
    return number(worker), number(simulator), number(full)


def test_workers_per_learner_follow_from_the_benchmarks(model):
    worker, simulator, taken_up = model
    assert f"full at {taken_up:,.0f} env steps/s with 2 samples" in TEXT
    for setup, rate, workers, cpus in table("setup"):
        if setup == "10r×2g":
            expected = worker
        else:
            expected = benchmark(f" {setup} ", 5) * worker / simulator
        stated = number(re.search(r"([\d,]+)(?: \(measured\))?$", rate)[1])
        assert stated == pytest.approx(expected, rel=0.03)
        assert int(workers) == math.ceil(taken_up / stated)
        assert int(cpus) == int(workers) + 2, "the learner and the driver"


def test_trainings_per_node_follow_from_the_table_of_setups():
    needs = {setup: int(cpus) for setup, _, _, cpus in table("setup")}
    for nodes, trainings, cells, _ in table("nodes"):
        assert int(cells) == CELLS_A_NODE * int(nodes)
        small, large = re.fullmatch(r"(\d+) of 10r×2g, or (\d+ of \S+)", trainings).groups()
        assert int(small) == CELLS_A_NODE // needs["10r×2g"] * int(nodes), "each on one node"
        count, setup = large.split(" of ")
        assert int(count) == CELLS_A_NODE * int(nodes) // needs[setup]


def test_shoal_commands_parse():
    commands = re.findall(r"(?:^|[ /])shoal ((?:train|sweep) [^'\n#]*?)\s*(?:['#]|$)", PAGE, re.MULTILINE)
    assert len(commands) >= 4
    for command in commands:
        parse(shlex.split(command))


def test_files_that_commands_name_exist():
    names = set(re.findall(r"\bdeploy/[\w./-]+\.yml|\bdeploy/Containerfile\b", PAGE))
    assert {"deploy/Containerfile", "deploy/ray-cluster.yml", "deploy/kubernetes/rayjob.yml"} <= names
    assert not [name for name in names if not (ROOT / name).is_file()]
