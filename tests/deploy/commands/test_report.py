"""`shoal report`, from tables of results to the folder that it writes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from actors.evaluation.result_table import ResultRow, write_table
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.statements import NO_FIELD
from dashboards.figures.result_figures import PICTURES
from dashboards.report import DRAWINGS
from deploy.commands import report
from deploy.options.results import Report
from learner.file_names import VARIANTS
from sim_core.checks import ConfigError
from tests.dashboards.tables import claimed_table, row

COMMON = {"claims.md", "report.md", *(drawing.file for drawing in DRAWINGS)}


def made(rows: list[ResultRow], folder: Path, name: str = "out") -> dict[str, bytes]:
    """The files of a report on `rows`, by their path in its folder."""
    write_table(folder / "results.csv", rows)
    assert report.run(Report(results=(folder / "results.csv",), out=folder / name)) == 0
    paths = [path for path in (folder / name).rglob("*") if path.is_file()]
    return {path.relative_to(folder / name).as_posix(): path.read_bytes() for path in paths}


BOTH = [
    *claimed_table(),
    row("sensor", Setup(5, 1), success=80, preset="best"),
    row("out", Setup(10, 2), success=90, preset="best"),
]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a report on two presets."""
    return made(BOTH, tmp_path_factory.mktemp("both"))


@pytest.fixture
def unsaved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are drawn, but saved as empty files: for tests of names and texts."""
    monkeypatch.setattr("deploy.commands.report.save_png", lambda figure, path: path.write_bytes(b""))


@pytest.mark.usefixtures("unsaved")
def test_one_preset_needs_no_folder_and_replaces_an_older_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "claims.md").write_text("old")
    files = made(claimed_table(), tmp_path)
    assert set(files) == COMMON | {picture.file for picture in PICTURES}
    page = files["claims.md"].decode()
    assert page.startswith("# The dissertation's claims") and "15 holds" in page
    assert "thesis: 15 holds" in capsys.readouterr().out


def test_every_preset_has_a_folder_and_every_link_works(both: dict[str, bytes]):
    assert set(both) == COMMON | {f"{name}/{picture.file}" for name in ("thesis", "best") for picture in PICTURES}
    page = both["report.md"].decode()
    assert set(re.findall(r"\]\(([^)]+)\)", page)) == set(both) - {"report.md"}
    assert "| M_sensor | 1 | 94.0 % | 80.0 % | 1 | 0 |" in page
    assert both["claims.md"].decode().count("## Preset ") == 2
    assert both["thesis/heatmap.png"] != both["best/heatmap.png"]


def test_the_same_results_give_the_same_bytes(both: dict[str, bytes], tmp_path: Path):
    assert made(BOTH[::-1], tmp_path, "elsewhere") == both


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no results of a learned policy"),
        ([row("sensor", Setup(5, 1), success=50)._replace(policy="orca")], "no results of a learned policy"),
    ],
)
def test_refuses_what_cannot_be_reported(rows: list[ResultRow], message: str, tmp_path: Path):
    write_table(tmp_path / "results.csv", rows)
    with pytest.raises(ConfigError, match=re.escape(message)):
        report.run(Report(results=(tmp_path / "results.csv",), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_refuses_a_missing_file(tmp_path: Path):
    with pytest.raises(ConfigError, match="cannot be read"):
        report.run(Report(results=(tmp_path / "none.csv",), out=tmp_path / "out"))


@pytest.mark.usefixtures("unsaved")
def test_several_tables_are_shown_side_by_side(both: dict[str, bytes], tmp_path: Path):
    tables = tuple(tmp_path / name for name in ("thesis.csv", "best.csv"))
    for table in tables:
        write_table(table, [line for line in BOTH if line.preset == table.stem])
    assert report.run(Report(results=tables, out=tmp_path / "out")) == 0
    page = (tmp_path / "out" / "report.md").read_text()
    names = ", ".join(f"`{tmp_path.name}/{table.name}`" for table in tables)
    assert page.replace(names, "`results.csv`") == both["report.md"].decode()
    assert re.search(r"^\| 14 \| .* \| holds \(10 of 10\) \| no data \(1 of 10\) \|$", page, re.MULTILINE)


@pytest.mark.usefixtures("unsaved")
def test_variants_beside_the_table_decide_what_it_cannot(tmp_path: Path):
    assert re.search(r"^\| 24 \| .* \| no data \|", made(claimed_table(), tmp_path)["report.md"].decode(), re.MULTILINE)
    write_table(tmp_path / VARIANTS, [row("out", Setup(5, 1), success=70, preset=f"thesis+{NO_FIELD}")])
    page = made(claimed_table(), tmp_path)["report.md"].decode()
    assert re.search(r"^\| 24 \| .* \| \*\*does not hold\*\* \| 5r×1g 70.0 %", page, re.MULTILINE)
    assert page.count("## Preset ") == 1 and NO_FIELD not in page


@pytest.mark.usefixtures("unsaved")
def test_a_policy_in_two_tables_counts_once_and_is_refused_if_they_differ(tmp_path: Path):
    rows = claimed_table()
    write_table(tmp_path / "results.csv", rows)
    write_table(tmp_path / "more.csv", [rows[0], *(line._replace(seed=1) for line in rows[1:])])
    tables = (tmp_path / "results.csv", tmp_path / "more.csv")
    assert report.run(Report(results=tables, out=tmp_path / "out")) == 0
    assert "| 1 … 2 |" in (tmp_path / "out" / "report.md").read_text()
    write_table(tmp_path / "more.csv", [rows[0]._replace(goal=rows[0].goal - 1, lost=rows[0].lost + 1)])
    with pytest.raises(ConfigError, match="twice"):
        report.run(Report(results=tables, out=tmp_path / "out"))


@pytest.mark.parametrize("changed", ["sector_frame=goal", "arena_radius_m=2.0", "learning_rate=1e+3", "no=setting"])
def test_settings_that_do_not_fit_the_diagrams_leave_the_report_complete(
    changed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(report, "pictures_of", lambda results: ())  # they show results, not settings
    rows = [line._replace(preset=f"thesis+{changed}") for line in claimed_table()[:3]]
    assert set(made(rows, tmp_path)) == COMMON


@pytest.mark.usefixtures("unsaved")
def test_a_presets_name_cannot_leave_the_folder(tmp_path: Path):
    names = ("../elsewhere", "thesis+a=[1, 2]", "thesis")
    made([row("sensor", Setup(5, 1), success=50, preset=name) for name in names], tmp_path, "deep/out")
    assert {path.name for path in tmp_path.iterdir()} == {"results.csv", "deep"}
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"out"}
    folders = {path.name for path in (tmp_path / "deep" / "out").iterdir() if path.is_dir()}
    assert len(folders) == 3 and "thesis" in folders and not any(" " in name or "[" in name for name in folders)


@pytest.mark.parametrize("out", ["file", "file/deeper"])
def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path, out: str):
    write_table(tmp_path / "results.csv", [row("sensor", Setup(5, 1), success=50)])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out"):
        report.run(Report(results=(tmp_path / "results.csv",), out=tmp_path / out))
