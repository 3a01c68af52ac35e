"""Learning curves, read back from the pixels of the PNG."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.trainings import CurvePoint
from dashboards.figures.learning_curve import VALUE, learning_curve_png

Colour = str | tuple[float, float, float]


def rising(failures: dict[str, float] | None) -> list[CurvePoint]:
    return [CurvePoint(50_000 * k, 0.1 * k, 0.1 * k - 0.08, 0.1 * k + 0.08, failures) for k in range(1, 9)]


def draw(path: Path, rows: list[CurvePoint], **options: object) -> np.ndarray:
    learning_curve_png(rows, path, "10r×2g", **options)  # type: ignore[arg-type]
    return matplotlib.image.imread(path)[..., :3]


def places(image: np.ndarray, colour: Colour, tolerance: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """(rows, columns) of the pixels of a colour."""
    rgb = np.array(to_rgb(colour), np.float64)
    rows, columns = np.nonzero(np.abs(image - rgb).max(axis=-1) < tolerance)
    return rows, columns


def height_at(image: np.ndarray, colour: Colour, share: float) -> float:
    """Mean height of a colour, as a share of the image, in a narrow band at `share` of the width."""
    rows, columns = places(image, colour)
    near = np.abs(columns / image.shape[1] - share) < 0.02
    return float(1.0 - rows[near].mean() / image.shape[0])


def test_line_rises_with_the_values_and_the_band_surrounds_it(tmp_path: Path):
    image = draw(tmp_path / "curve.png", rising(None))
    heights = [height_at(image, VALUE, share) for share in (0.3, 0.5, 0.7, 0.9)]
    assert np.all(np.diff(heights) > 0.05)
    red, green, blue = (1.0 - 0.2 * (1.0 - channel) for channel in to_rgb(VALUE))
    rows, columns = places(image, (red, green, blue))
    column = int(0.6 * image.shape[1])
    shaded, line = rows[columns == column], places(image[:, column : column + 1], VALUE)[0]
    assert shaded.min() < line.min() - 10 and shaded.max() > line.max() + 10


def test_the_axis_of_shares_is_fixed_and_that_of_returns_fits_the_data(tmp_path: Path):
    low = [row._replace(value=0.1 * row.value, low=0.0, high=0.1) for row in rising(None)]
    as_share = draw(tmp_path / "share.png", low)
    as_return = draw(tmp_path / "return.png", low, value_label="mean return", is_share=False)
    assert height_at(as_share, VALUE, 0.9) < 0.35 < height_at(as_return, VALUE, 0.9)


def test_failures_have_a_subplot_with_one_line_each(tmp_path: Path):
    plain = draw(tmp_path / "plain.png", rising(None))
    some = draw(tmp_path / "some.png", rising({"lost": 0.3, "collision": 0.1}))
    assert some.shape[0] > plain.shape[0]
    for name, (colour, *_) in FAILURE_STYLES.items():
        if name != "timeout":
            assert (len(places(some, colour)[0]) > 50) == (name in ("lost", "collision")), name
    lost, collision = (height_at(some, FAILURE_STYLES[name].colour, 0.6) for name in ("lost", "collision"))
    assert lost > collision + 0.05


def test_failures_may_be_missing_from_some_rows(tmp_path: Path):
    rows = rising(None)[:4] + rising({"captured": 0.2, "lost": 0.5})[4:]
    image = draw(tmp_path / "curve.png", rows)
    _, columns = places(image[image.shape[0] * 2 // 3 :], FAILURE_STYLES["captured"].colour)
    assert columns.min() > 0.45 * image.shape[1]


def test_one_evaluation_is_a_point_with_its_interval(tmp_path: Path):
    image = draw(tmp_path / "one.png", [CurvePoint(1000, 0.5, 0.3, 0.7, None)])
    rows, columns = places(image, VALUE)
    middle = rows[np.abs(columns - np.median(columns[rows > 0.4 * image.shape[0]])) < 3]
    assert np.ptp(middle) > 0.2 * image.shape[0]


def test_title_is_plain_text(tmp_path: Path):
    learning_curve_png(rising(None), tmp_path / "curve.png", r"$\frac{1$", value_label="cost in $")
    assert (tmp_path / "curve.png").stat().st_size > 10_000


def test_pyplot_is_not_used(tmp_path: Path):
    from matplotlib import pyplot

    learning_curve_png(rising({"lost": 0.2}), tmp_path / "curve.png", "10r×2g")
    assert pyplot.get_fignums() == []


def test_refuses_no_rows(tmp_path: Path):
    with pytest.raises(ValueError, match="no evaluations"):
        learning_curve_png([], tmp_path / "curve.png", "10r×2g")
