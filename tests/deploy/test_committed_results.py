"""The committed results: `shoal report` reproduces the committed report, and the presets have not changed since."""

import dataclasses
import json
import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dashboards
from actors.evaluation.result_table import LEARNED, read_table
from actors.evaluation.value_table import read_values
from dashboards.analysis.claim_checks import Verdict
from dashboards.analysis.claims import judge
from dashboards.analysis.comparison import results_of
from deploy.cli import main
from deploy.report_data.beside import values_beside, variants_beside
from deploy.runs.sweep_provenance import grid_of, read_provenance
from learner.config import RunConfig, to_dict
from learner.file_names import RESULTS, SETTINGS, VALUES, VARIANTS
from learner.sweep.grid import expected_hash, make_cell, sweep_of_label

ROOT = Path(dashboards.__file__).parent / "results"
CLAIMS = ROOT.parent / "CLAIMS.md"
FOLDERS = sorted(path.parent for path in ROOT.glob("*/results.csv"))


def sweep_of(folder):
    return grid_of(json.loads((folder / "settings.json").read_text())["sweep"])


def trained_seeds(command):
    """Training seeds of a command; `--seeds` without any has none, a sweep without it the default's."""
    told = re.search(r"--seeds((?: \d+)*)", command)
    if told:
        return {int(seed) for seed in told[1].split()}
    return {0, 1, 2} if command.startswith("shoal sweep") else set()


def test_there_are_committed_results():
    assert FOLDERS


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_provenance_of_the_results_is_known(folder):
    provenance = read_provenance(folder / "results.csv")
    assert provenance and all(re.fullmatch("[0-9a-f]{40}", each.commit) for each in provenance)
    seeds = {row.seed for row in read_table(folder / "results.csv") if row.policy == LEARNED}
    assert seeds == set().union(*(trained_seeds(each.command) for each in provenance))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_committed_report_is_that_of_the_results(folder, tmp_path):
    assert main(["report", str(folder / "results.csv"), "--out", str(tmp_path)]) == 0
    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    committed = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    assert made == committed - {Path(name) for name in (RESULTS, SETTINGS, VALUES, VARIANTS)}
    for name in made:
        if name.suffix == ".md":
            assert (folder / name).read_text() == (tmp_path / name).read_text()
        else:  # another version of matplotlib may move letters by a pixel
            committed, new = (np.asarray(Image.open(root / name).convert("RGB"), float) for root in (folder, tmp_path))
            assert committed.shape == new.shape
            assert np.abs(committed - new).mean() < 2.0


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_rows_have_the_presets_current_settings(folder):
    sweep = sweep_of(folder)
    rows = read_table(folder / "results.csv")
    assert any(row.policy == LEARNED for row in rows) and any(row.policy != LEARNED for row in rows)
    for row in rows:
        assert row.preset == sweep.label
        assert row.config == expected_hash(sweep, row)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_no_default_has_changed_since_the_results(folder):
    # The hash leaves out defaults, so that a changed default must be found here.
    stored = json.loads((folder / "settings.json").read_text())["a_cell_of_each_method"]
    assert stored
    for method, values in stored.items():
        now = to_dict(
            make_cell(sweep_of(folder), method, values["world"]["robots"], values["world"]["groups"], 0).config
        )
        now = json.loads(json.dumps(now))
        for name in values.keys() - {"world", "seed"} & RunConfig.__dataclass_fields__.keys():
            assert now[name] == values[name], name
        assert {name: now["world"][name] for name in values["world"]} == values["world"]


def test_the_page_of_reasons_has_the_reports_verdicts_and_a_reason_for_each_that_fails():
    verdicts = re.findall(r"^\| (\d+) \|[^|]*\| \*\*([^*]+)\*\* \|", (ROOT / "thesis" / "claims.md").read_text(), re.M)
    rows = re.findall(r"^\| (\d+) \| ([a-z ]+) \|(.*)\|$", CLAIMS.read_text(), re.M)
    assert len(rows) == 26 and [(number, verdict) for number, verdict, _ in rows] == verdicts
    assert all((verdict == "holds") or len(reason) > 40 for _, verdict, reason in rows)


def test_the_page_of_reasons_says_which_claims_hold_in_which_world():
    rows = re.findall(
        r"^\|[^|]+\| \[[\w-]+\]\((results/[\w/-]+\.csv)\) \|([^|]*)\|([^|]*)\|$", CLAIMS.read_text(), re.M
    )
    assert len(rows) == 8
    for path, *told in rows:
        table = ROOT.parent / path
        (found,) = map(judge, results_of(read_table(table), variants_beside([table]), values_beside([table])).values())
        for verdict, text in zip((Verdict.HOLDS, Verdict.UNDECIDED), told, strict=True):
            numbers = [int(number) for number in re.findall(r"\d+", re.sub(r"\(.*\)", "", text))]
            assert numbers == [claim.number for claim in found if claim.verdict is verdict], (path, verdict)


def test_variants_have_the_settings_of_their_labels():
    (table,) = ROOT.glob(f"*/{VARIANTS}")
    told = [each.command for each in read_provenance(table)]
    for row in read_table(table):
        sweep = sweep_of_label(row.preset)
        assert sweep.set and any(f"--set {' '.join(sweep.set)} " in command for command in told)
        assert row.config == expected_hash(dataclasses.replace(sweep, episodes=1000, baseline_episodes=500), row)


def test_values_are_those_of_three_trainings_of_each_algorithm():
    (table,) = ROOT.glob(f"*/{VALUES}")
    rows = read_values(table)
    assert {row.preset for row in rows} == {sweep_of(table.parent).label}
    assert {(row.algorithm, row.seed) for row in rows} == set(product(("dqn", "double_dqn"), (0, 1, 2)))


TRIED = sorted((ROOT / "tried").glob("*.csv"))
CALIBRATION = {"episodes": 600, "baseline_episodes": 600, "first_seed": 3_000_000_000}
LONGER = {"env_steps": 1_000_000}
FRESH = {"first_seed": 2_000_000_000}
OTHERS = {
    **dict.fromkeys(("ellipses", "poor-in", "surrounded", "unfinished", "unsettled"), LONGER),
    "falling": LONGER | FRESH | {"episodes": 3_000, "baseline_episodes": 500},
    "nearest": FRESH | {"episodes": 3_000},
    "nearest-ellipses": FRESH | {"episodes": 1_000},
}
"""What tables have that differ from those of calibration: longer trainings, other episodes."""


@pytest.mark.parametrize("table", TRIED, ids=lambda table: table.stem)
def test_tables_of_experiments_have_the_settings_of_their_labels(table):
    rows = read_table(table)
    assert rows
    for row in rows:
        sweep = sweep_of_label(row.preset)
        sweep = dataclasses.replace(sweep, **CALIBRATION | OTHERS.get(table.stem, {}))
        assert row.config == expected_hash(sweep, row)
