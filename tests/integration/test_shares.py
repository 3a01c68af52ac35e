"""The study of shares: what it keeps, counts and draws."""

import csv

import numpy as np
import pytest

from actors.policy.baselines import Baseline
from sim_core.outcomes import Outcome
from tests.benchmarks import shares
from tests.benchmarks.learners import SHARES
from tests.benchmarks.shares import Played, Study, parse

GOAL, HIT, LATE = (int(outcome) for outcome in (Outcome.GOAL, Outcome.COLLISION, Outcome.TIMEOUT))


@pytest.fixture
def study(tmp_path):
    return Study("sensor", "3x2", parse(["--worlds", "4", "--seeds", "0", "--runs-dir", str(tmp_path)]))


def played(*outcomes):
    return Played(np.array(outcomes, np.int8))


def test_cells_count_robots_worlds_and_collisions():
    two_seeds = played([[GOAL, GOAL], [GOAL, HIT]], [[LATE, LATE], [GOAL, HIT]])
    assert two_seeds.text() == "50 ± 25; all 25; hit 25"
    assert two_seeds.arrived.tolist() == [0.5, 0.5]
    assert played([[GOAL], [GOAL], [GOAL], [LATE]]).text() == "75"


def test_differences_are_paired_by_world(study):
    hard_and_easy = np.where(np.arange(40) % 2, GOAL, LATE)[None, :, None]
    better = hard_and_easy.copy()
    better[0, 0] = GOAL
    found = {f"trained at {share}": dict.fromkeys(SHARES, Played(hard_and_easy)) for share in SHARES}
    found["trained at 1.0"] = dict.fromkeys(SHARES, Played(better))
    rows = list(zip(*(column.cells for column in shares.differences(study, found).columns), strict=True))
    assert rows[0] == ("trained at 0.25", *["+0 (+0 … +0)"] * len(SHARES))
    value, low, high = (float(word.strip("()")) for word in rows[-1][1].replace("…", "").split())
    assert value == 2 and -4 < low < 0 < high < 9  # unpaired, the interval would be 31 points wide


def test_what_has_been_played_is_not_played_again(study, monkeypatch):
    first = study.play({"r": Baseline.FL_ORCA}, "1.0")
    assert first.outcome.shape == (1, 4, 6)
    monkeypatch.setattr(shares, "evaluate", lambda *_: pytest.fail("played again"))
    assert np.array_equal(study.play({"r": Baseline.FL_ORCA}, "1.0").outcome, first.outcome)


def test_trainings_differ_in_their_share_and_are_kept_by_name(study, monkeypatch):
    asked = {}
    monkeypatch.setattr(shares, "trained", lambda folder, name, settings: asked.update({name: settings}))
    for learners in SHARES:
        study.train(learners, 1)
    assert list(asked) == [f"sensor-3x2-{learners}-1" for learners in SHARES]
    assert ["--teacher" in settings for settings in asked.values()] == [share != "one" for share in SHARES]
    settings = asked["sensor-3x2-0.25-1"]
    assert settings[settings.index("--learners") + 1] == "0.25" and "--sector-frame" not in settings


def test_results_are_written_for_figures(study, tmp_path):
    found = {"fl-orca": {share: study.play({"r": Baseline.FL_ORCA}, share) for share in SHARES}}
    shares.write(tmp_path / "shares.csv", [(study, found)])
    rows = list(csv.DictReader((tmp_path / "shares.csv").read_text().splitlines()))
    assert [row["played_at"] for row in rows] == list(SHARES)
    assert all(0 <= float(row["low"]) <= float(row["arrive"]) <= float(row["high"]) <= 1 for row in rows)
    panel = shares.panel(study, found)
    assert panel.values == (0.167, 0.333, 0.667, 1.0)
    assert [rate.value for rate in panel.curves["fl-orca"]] == pytest.approx(
        [float(row["arrive"]) for row in rows], abs=1e-4
    )
