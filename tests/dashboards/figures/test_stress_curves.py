"""Curves under bad senses: what is drawn where, and refusals."""

import numpy as np
import pytest
from PIL import Image

from actors.evaluation.statistics import rate
from dashboards.figures.stress_curves import Panel, stress_curves_png

LOSS = Panel("position_loss, 5r×2g", (0.0, 0.5, 1.0), {"a": [rate(9, 10)] * 3, "b": [rate(n, 10) for n in (9, 5, 1)]})
SHIELD = Panel("shield, 5r×2g", ("none", "orca"), {"a": [rate(1, 10), rate(9, 10)], "b": [rate(5, 10)] * 2})


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_every_player_has_its_curve_in_every_panel(tmp_path):
    stress_curves_png([LOSS, SHIELD], tmp_path / "c.png", "under $bad$ senses")
    found = pixels(tmp_path / "c.png")
    left, right = np.split(found, [found.shape[1] // 2], axis=1)
    for half in (left, right):
        for colour in ((0, 114, 178), (213, 94, 0)):
            assert (np.abs(half - colour).max(axis=-1) < 12).sum() > 20
    falls = np.argwhere(np.abs(left - (213, 94, 0)).max(axis=-1) < 12)  # (row, column) of the curve of b, and its key
    assert falls[falls[:, 1].argmax(), 0] - falls[falls[:, 1].argmin(), 0] > 60


def test_the_same_results_give_the_same_bytes(tmp_path):
    for name in ("one.png", "two.png"):
        stress_curves_png([LOSS, SHIELD, LOSS], tmp_path / name, "title")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_without_a_panel_there_is_nothing_to_draw(tmp_path):
    with pytest.raises(ValueError, match="no conditions"):
        stress_curves_png([], tmp_path / "none.png", "title")
    assert not (tmp_path / "none.png").exists()
