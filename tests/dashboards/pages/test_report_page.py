"""The HTML report in Chromium: drawn data, mouse, keyboard, colour schemes, and isolation from the network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.evaluation.trajectory import Episode
from dashboards.analysis.aggregate import GROUPS, ROBOTS, Results, Setup
from dashboards.analysis.claims import judge
from dashboards.analysis.methods import method_label
from dashboards.pages.player import player_data
from dashboards.pages.report_page import EpisodeGroup, ReportContents, TableSection, report_data, report_page
from dashboards.plotly_charts.result_charts import failure_causes, heatmaps, transfers
from dashboards.plotly_charts.run_charts import setup_curves, sweep_speeds
from sim_core.config import WorldConfig
from sim_core.plugins import DISSERTATION_METHODS
from tests.dashboards.chromium import complaints, emulate_scheme, emulate_width, press, two_frames, wait_until
from tests.dashboards.contrast import poor_texts
from tests.dashboards.plotly_charts.test_charts import TRAININGS, counted
from tests.dashboards.tables import claimed_table, row

EVIL = "</script><b>&{{data}}"
ROWS = claimed_table(row("sensor", Setup(5, 1), success=60))
RESULTS = Results(ROWS)
CLAIMS = judge(RESULTS)
KEYS = ("sensor-5r2g", "out-10r2g")
GROUPS_OF = [
    EpisodeGroup(KEYS[0], "thesis", "learned", "sensor", "5r×2g", "0", "5r×2g", {"goal": 90, "lost": 10}),
    EpisodeGroup(KEYS[1], "thesis", "learned", "out", "10r×2g", "0", "10r×2g", {"goal": 7, "timeout": 3}),
]


def contents() -> ReportContents:
    presets = {"thesis": RESULTS}
    charts = [heatmaps(presets), transfers(presets), failure_causes(presets)]
    return ReportContents(
        title=EVIL,
        subtitle="made up",
        made="by a test",
        facts=[("cells", "75 of 75")],
        charts=[*charts, setup_curves(TRAININGS), sweep_speeds(TRAININGS)],
        claims={"thesis": CLAIMS},
        tables=[TableSection("running", "Unfinished cells", "", setup_curves(TRAININGS).views["5r×1g"].table)],
        groups=GROUPS_OF,
        episodes_note="some episodes",
    )


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, episode: Episode, failed: Episode, config: WorldConfig) -> Path:
    samples = {
        f"{KEYS[0]}|goal|0": player_data(episode, config),
        f"{KEYS[0]}|lost|0": player_data(failed, config),
        f"{KEYS[0]}|lost|1": player_data(failed._replace(seed=99), config),
    }
    file = tmp_path_factory.mktemp("report") / "dashboard.html"
    file.write_text(report_page(EVIL, report_data(contents()), samples, live=False), encoding="utf-8")
    return file


@pytest.fixture
def page(browser: Any, path: Path) -> Iterator[Any]:
    """The report from disk; the test fails on an error in the console, or a request for anything but the file."""
    browser.get_log("performance")
    browser.get(path.as_uri())
    ready(browser)
    yield browser
    assert complaints(browser) == []
    assert requested(browser) <= {path.as_uri()}


def ready(browser: Any) -> None:
    wait_until(browser, "document.body.dataset.ready === 'yes' && data !== null")


def requested(browser: Any) -> set[str]:
    """Addresses that the page has requested, except data and blob URLs."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    urls = [params["request"]["url"] for params in sent if params["documentURL"].startswith(("file:", "http:"))]
    return {url.split("#")[0] for url in urls if not url.startswith(("data:", "blob:"))}


def plots(page: Any, section: str) -> list[dict[str, Any]]:
    script = """return [...document.querySelectorAll(`#${arguments[0]} .plot`)].map(p => ({
        title: p.closest('figure').querySelector('figcaption').textContent,
        data: JSON.parse(JSON.stringify(p.data)), drawn: p._fullLayout.width,
        width: p.clientWidth, height: p.clientHeight,
        texts: [...p.querySelectorAll('.annotation-text')].map(t => t.textContent),
        bars: [...p.querySelectorAll('.trace.bars')].map(t => t.querySelectorAll('.point path').length)}))"""
    return list(page.execute_script(script, section))


def choose(page: Any, section: str, label: str, value: str) -> None:
    script = """const s = document.querySelector(`#${arguments[0]} select[aria-label="${arguments[1]}"]`);
        s.value = arguments[2]; s.dispatchEvent(new Event('change'))"""
    page.execute_script(script, section, label, value)
    two_frames(page)


def test_the_page_is_one_file_hardly_larger_than_its_library(path: Path):
    assert path.stat().st_size < 2_600_000
    assert "connect-src" not in path.read_text("utf-8").split("</head>")[0]


def test_the_title_is_escaped(page: Any):
    assert page.title == EVIL and page.find_element("tag name", "h1").text == EVIL
    assert page.execute_script("return document.querySelectorAll('b').length") == 1  # that of the claims
    ids = page.execute_script("return [...document.querySelectorAll('body [id]')].map(node => node.id)")
    assert len(ids) == len(set(ids)) > 30


def test_heat_maps_draw_every_cell(page: Any):
    drawn = plots(page, "success")
    assert [plot["title"] for plot in drawn] == [method_label(method) for method in DISSERTATION_METHODS]
    for plot, method in zip(drawn, DISSERTATION_METHODS, strict=True):
        rates = [[counted_here(method, Setup(n, m)) for m in GROUPS] for n in ROBOTS]
        assert plot["data"][0]["z"] == [[pytest.approx(rate) for rate in line] for line in rates]
        texts = [f"{100 * rate:.1f}" for line in rates for rate in line]
        assert [seen.startswith(text) for seen, text in zip(plot["texts"], texts, strict=True)] == [True] * 25


def counted_here(method: str, setup: Setup) -> float:
    cell = RESULTS.fixed(method, setup)
    assert cell is not None
    return sum(r.goal for r in cell.rows) / cell.episodes


def test_a_click_on_a_cell_selects_its_setup_everywhere(page: Any):
    from selenium.webdriver.common.action_chains import ActionChains

    heat = page.execute_script("return document.querySelectorAll('#success .plot')[2]")
    size = page.execute_script(
        "const {xaxis: x, yaxis: y} = arguments[0]._fullLayout; return [x._offset, x._length, y._offset, y._length]",
        heat,
    )
    x, y = size[0] + 0.3 * size[1], size[2] + 0.3 * size[3]  # second column, second row: 10r×2g
    box = heat.size
    page.execute_script("arguments[0].scrollIntoView({block: 'center'})", heat)
    ActionChains(page).move_to_element_with_offset(heat, x - box["width"] / 2, y - box["height"] / 2).click().perform()
    wait_until(page, "document.querySelector('#transfer').dataset.view === 'thesis|out|10r×2g'")
    assert page.execute_script("return document.querySelector('#curves').dataset.view") == "10r×2g"
    assert page.execute_script("return episodes.chosen.method + episodes.chosen.trained") == "out10r×2g"
    assert "M_OUT 10r×2g" in page.find_element("id", "success").text


def test_transfer_follows_its_choices(page: Any):
    choose(page, "transfer", "Trained in", "10r×2g")
    panel = plots(page, "transfer")[1]
    assert panel["title"] == "Trained in 10r×2g, with other groups"
    fixed, foreign = panel["data"]
    assert foreign["y"] == [pytest.approx(counted("sensor", Setup(10, m), Setup(10, 2)).goal / 3000) for m in (3, 4, 8)]
    assert panel["bars"] == [5, 3]
    choose(page, "transfer", "Trained in", "25r×8g")
    assert "no data for this choice" in page.find_element("id", "transfer").text
    choose(page, "transfer", "Trained in", "5r×1g")
    assert plots(page, "transfer")[0]["title"].startswith("Trained in 5r×1g")


def test_failures_and_curves_are_drawn(page: Any):
    for plot in plots(page, "failures"):
        assert plot["bars"] == [25] * 4
    assert len(plots(page, "curves")[0]["data"]) == 3 * 6
    choose(page, "curves", "Setup", "5r×1g")
    assert plots(page, "curves")[0]["title"] == "Success in 5r×1g"
    rows = page.execute_script("return document.querySelectorAll('#curves tbody tr').length")
    assert rows == 4 * 6
    assert len(plots(page, "throughput")[0]["data"]) == 3


def test_the_judged_claims_are_shown(page: Any):
    script = """return [...document.querySelectorAll('#claims tr[data-claim]')].map(r => [r.dataset.verdict,
        r.querySelector('.verdict-mark').textContent, r.querySelectorAll('details tbody tr').length])"""
    marks = {"holds": "✓ holds", "does not hold": "✗ does not hold", "undecided": "? undecided", "no data": "– no data"}
    expected = [[str(c.verdict), marks[str(c.verdict)], len(c.checks)] for c in CLAIMS]
    assert page.execute_script(script) == expected
    assert len({verdict for verdict, _, _ in expected}) > 1
    assert "5r×1g 60.0 %" in page.find_element("css selector", "#claims tr[data-claim='1']").text


def test_numbers_are_shown_in_tables_too(page: Any):
    script = (
        "return [...document.querySelectorAll('#success tbody tr')].map(r => [...r.children].map(c => c.textContent))"
    )
    rows = page.execute_script(script)
    assert len(rows) == 15
    assert rows[1][:3] == ["M_sensor", "10r", "94.0 % (93.1 … 94.8)"]


def test_episodes_are_chosen_by_setup_and_outcome(page: Any, failed: Episode):
    assert page.find_element("id", "verdict").text.startswith("Success")
    options = "return [...document.querySelectorAll('[aria-label=Outcome] option')].map(o => o.textContent)"
    assert page.execute_script(options) == ["goal (90)", "lost (10)"]
    choose(page, "episodes", "Outcome", "lost")
    wait_until(page, "data.outcome === 'lost'")
    verdict = page.find_element("id", "verdict")
    assert verdict.text.startswith("Failure, lost") and verdict.get_attribute("class") == "verdict failure"
    assert page.find_element("id", "episode-missing").text == "Episode 1 of 2"
    page.find_element("css selector", "[aria-label='Next episode']").click()
    wait_until(page, "data.setup.endsWith('seed 99')")
    assert page.execute_script("return data.steps") == len(failed.action) - 1
    page.find_element("css selector", "[aria-label='Next episode']").click()
    wait_until(page, f"data.setup.endsWith('seed {failed.seed}')")
    choose(page, "episodes", "Method", "out")
    assert "No episode of this outcome" in page.find_element("id", "episode-missing").text
    assert not page.find_element("id", "player").is_displayed()
    choose(page, "episodes", "Method", "sensor")
    assert page.find_element("id", "player").is_displayed()


def test_keys_control_the_player_in_focus_and_scroll_elsewhere(page: Any):
    from selenium.webdriver.common.keys import Keys

    page.execute_script("canvas.focus()")
    press(page, Keys.ARROW_RIGHT)
    assert page.execute_script("return step") == 1
    press(page, Keys.SPACE)
    assert page.execute_script("return playing")
    press(page, Keys.SPACE)
    press(page, Keys.HOME)
    page.execute_script("document.activeElement.blur(); scrollTo(0, 0)")
    press(page, Keys.SPACE)
    wait_until(page, "scrollY > 0")
    assert not page.execute_script("return playing")


def test_every_control_is_reached_by_tab_and_has_a_name(page: Any):
    from selenium.webdriver.common.keys import Keys

    unnamed = """const named = e => e.getAttribute('aria-label') || e.labels?.length
            || e.textContent.trim() && e.tagName === 'BUTTON';
        return [...document.querySelectorAll('button, input, select, [role=img]')]
            .filter(e => e.checkVisibility() && !named(e)).length"""
    assert page.execute_script(unnamed) == 0
    page.execute_script("document.querySelector('#transfer select').focus()")
    seen = []
    for _ in range(16):
        press(page, Keys.TAB)
        seen += page.execute_script(
            "const e = document.activeElement; return [e.tagName, e.getAttribute('aria-label')]"
        )
    assert {"Trained in", "SUMMARY", "Setup", "Outcome", "CANVAS", "Step"} <= set(seen)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_have_enough_contrast(page: Any, scheme: str):
    with emulate_scheme(page, scheme):
        two_frames(page)
        page.execute_script("for (const d of document.querySelectorAll('details')) d.open = true")
        page.execute_script("for (const id of ['machine', 'planes']) element(id).click()")
        ground = page.execute_script("return getComputedStyle(document.body).backgroundColor")
        poor = poor_texts(page)
        page.execute_script("for (const id of ['machine', 'planes']) element(id).click()")
    assert (ground == "rgb(255, 255, 255)") == (scheme == "light")
    assert poor == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_lines_and_bars_have_enough_contrast(page: Any, scheme: str):
    """WCAG 1.4.11: graphical objects have a contrast of at least 3 with the page."""
    with emulate_scheme(page, scheme):
        two_frames(page)
        script = """const style = getComputedStyle(document.documentElement), probe = document.createElement('span');
            document.body.append(probe);
            const read = name => {
                probe.style.color = style.getPropertyValue(name);
                return getComputedStyle(probe).color;
            };
            const found = arguments[0].map(name => [name, read(name)]); const page = read('--page'); probe.remove();
            return [page, found]"""
        names = "--sensor --in --out --fixed --transfer --lost --captured --collision --timeout --accent".split()
        ground, colours = page.execute_script(script, names)
    from tests.dashboards.contrast import contrast_of

    assert {name: contrast_of(colour, ground) for name, colour in colours if contrast_of(colour, ground) < 3} == {}


def test_charts_follow_the_scheme(page: Any):
    colour = "return document.querySelector('#curves .plot')._fullData[2].line.color"
    light = page.execute_script(colour)
    with emulate_scheme(page, "dark"):
        wait_until(page, f"document.querySelector('#curves .plot')._fullData[2].line.color !== {light!r}")
    wait_until(page, f"document.querySelector('#curves .plot')._fullData[2].line.color === {light!r}")


def test_it_fits_a_narrow_screen(page: Any):
    with emulate_scheme(page, "dark"):
        two_frames(page)
    with emulate_width(page, 340):
        two_frames(page)
        wait_until(page, "document.querySelector('#success .plot')._fullLayout.width < 340")
        width, canvas = page.execute_script("return [document.documentElement.scrollWidth, canvas.clientWidth]")
        for section in ("success", "transfer"):
            assert all(plot["drawn"] == pytest.approx(plot["width"], abs=1) for plot in plots(page, section))
            assert all(plot["height"] == 300 for plot in plots(page, section))
    assert width <= 340
    assert canvas > 280


def test_the_page_cannot_connect_to_anything(browser: Any, path: Path):
    browser.get(path.as_uri())
    ready(browser)
    script = (
        """const done = arguments[0]; fetch('http://127.0.0.1:9/').then(() => done('reached'), () => done('refused'))"""
    )
    assert browser.execute_async_script(script) == "refused"
    assert any("Content Security Policy" in entry["message"] for entry in complaints(browser))
