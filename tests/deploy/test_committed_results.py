"""The committed results: `shoal report` makes the committed report of them, and the presets are still theirs."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dashboards
from actors.evaluation.result_table import LEARNED, read_table
from deploy.cli import main
from deploy.runs.sweep_provenance import grid_of, read_provenance
from learner.config import RunConfig, to_dict
from learner.sweep.grid import expected_hash, make_cell, sweep_of_label

ROOT = Path(dashboards.__file__).parent / "results"
FOLDERS = sorted(path.parent for path in ROOT.glob("*/results.csv"))


def sweep_of(folder):
    return grid_of(json.loads((folder / "settings.json").read_text())["sweep"])


def test_there_are_results():
    assert FOLDERS


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_commands_that_made_the_results_are_known(folder):
    sittings = read_provenance(folder / "results.csv")
    assert sittings and all(re.fullmatch("[0-9a-f]{40}", sitting.commit) for sitting in sittings)
    seeds = {row.seed for row in read_table(folder / "results.csv") if row.policy == LEARNED}
    told = [re.search(r"--seeds ([\d ]+)", sitting.command) for sitting in sittings]
    assert seeds == {int(seed) for found in told for seed in (found[1].split() if found else "012")}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_report_is_that_of_the_results(folder, tmp_path):
    assert main(["report", str(folder / "results.csv"), "--out", str(tmp_path)]) == 0
    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    assert made == {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} - {
        Path("results.csv"),
        Path("settings.json"),
    }
    for name in made:
        if name.suffix == ".md":
            assert (folder / name).read_text() == (tmp_path / name).read_text()
        else:  # another version of the plotting library may move letters by a pixel
            committed, new = (np.asarray(Image.open(root / name).convert("RGB"), float) for root in (folder, tmp_path))
            assert committed.shape == new.shape
            assert np.abs(committed - new).mean() < 2.0


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_rows_are_of_the_preset_as_it_is(folder):
    sweep = sweep_of(folder)
    rows = [row for row in read_table(folder / "results.csv") if row.policy == LEARNED]
    assert rows
    for row in rows:
        assert row.preset == sweep.label
        assert row.config == expected_hash(sweep, row)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_no_default_has_moved_under_the_results(folder):
    # The hash leaves out what is as by default, so a default that changes must show here.
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


TRIED = sorted((ROOT / "tried").glob("*.csv"))


@pytest.mark.parametrize("table", TRIED, ids=lambda table: table.stem)
def test_what_was_tried_is_what_its_label_says(table):
    rows = read_table(table)
    assert rows
    for row in rows:
        sweep = dataclasses.replace(sweep_of_label(row.preset), episodes=600, first_seed=3_000_000_000)
        assert row.config == expected_hash(sweep, row)
