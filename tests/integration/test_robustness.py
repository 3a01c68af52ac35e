"""The study of policies trained for bad senses: its paired differences, breaking points and files."""

import csv

import numpy as np
import pytest

from tests.benchmarks import robustness
from tests.benchmarks.robustness import AXES, CLEAN, KINDS, Curve, parse

SETUP = "5r×2g"
EPISODES = 40


def curves():
    """The clean policy falls linearly to 0 along every axis, the others to a half of that; one episode in ten fails."""
    easy = (np.arange(EPISODES) % 10 > 0).astype(float)
    found = []
    for axis in AXES:
        share = 1 - np.arange(len(axis.values)) / (len(axis.values) - 1)
        for player, factor in ((CLEAN, 1.0), ("drawn", 0.5)):
            found.append(Curve(axis, SETUP, player, share[:, None] * factor * easy))
    return found


def columns(table):
    return [list(column.cells) for column in table.columns]


def test_differences_are_paired_with_the_clean_policy_without_conditions():
    setup, condition, clean, drawn = columns(robustness.table("in", curves(), parse([])))
    assert setup == [SETUP, "", "", "", ""] and condition[:2] == ["none", "position_loss 0.5"]
    assert clean[0] == "90.0: +0.0 (+0.0 … +0.0)"
    assert clean[1].startswith("45.0: -45.0 (-49.") and drawn[0].startswith("45.0: -45.0 (-49.")


def test_one_condition_alone_can_be_played():
    options = parse(["--conditions", "position_loss"])
    assert [axis.name for axis in robustness.axes_of(options)] == ["position_loss"]
    found = [curve for curve in curves() if curve.axis.name == "position_loss"]
    assert columns(robustness.table("in", found, options))[1] == ["none", "position_loss 0.5"]
    assert columns(robustness.breaks("in", found))[1] == ["position_loss"]


def test_a_player_breaks_where_its_mean_falls_to_a_half():
    _, axes, clean, drawn = columns(robustness.breaks("in", curves()))
    assert axes == [axis.name for axis in AXES]
    assert float(clean[3]) == pytest.approx(4 * (1 - 0.5 / 0.9), abs=0.01)  # dropped robots, 0 to 4
    assert drawn == ["0"] * len(AXES)


def test_the_file_has_every_point_with_its_interval(tmp_path):
    robustness.write(tmp_path / "in.csv", "in", curves())
    rows = list(csv.DictReader((tmp_path / "in.csv").read_text("utf-8").splitlines()))
    assert len(rows) == 2 * sum(len(axis.values) for axis in AXES)
    assert rows[0]["success"] == "0.9000" and float(rows[0]["low"]) < 0.9 < float(rows[0]["high"]) <= 1


def test_trainings_differ_in_what_their_names_say():
    assert len(set(KINDS.values())) == len(KINDS)
    flags = ("--history", "--track-steps", "--shield")
    named = [{flag for flag in flags if flag.split("-")[2] in kind} for kind in KINDS]
    assert [{flag for flag in flags if flag in KINDS[kind]} for kind in KINDS] == named
