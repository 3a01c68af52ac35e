"""The README files: short where promised, and every link, path, name and command in them exists."""

import re
import shlex
from pathlib import Path

import pytest

import deploy
from deploy.cli import parse

ROOT = Path(deploy.__file__).parent.parent
PACKAGES = ("sim_core", "actors", "learner", "deploy", "dashboards", "tests")
READMES = [ROOT / "README.md", *(path for package in PACKAGES for path in (ROOT / package).rglob("README.md"))]
CLAIMS = ROOT / "dashboards" / "CLAIMS.md"
LONGEST_LINES = {ROOT / "README.md": 200, CLAIMS: 150}
"""Lines of the pages that are read as a whole."""

each_readme = pytest.mark.parametrize("page", [*READMES, CLAIMS], ids=lambda path: str(path.relative_to(ROOT)))


def headings(page: Path) -> set[str]:
    """Anchors that GitHub makes of a page's headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def links(page: Path) -> list[tuple[str, str]]:
    """(path, anchor) of every relative link and picture of a page; either may be empty."""
    found = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    return [tuple(link.partition("#")[::2]) for link in found if "://" not in link]


def code_lines(page: Path) -> list[str]:
    """Lines of a page's shell commands, continued lines joined, without comments."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    joined = "\n".join(blocks).replace("\\\n", " ")
    return [re.sub(r"\s+# .*", "", line) for line in joined.splitlines()]


def test_there_is_a_readme_wherever_the_first_one_leads():
    led_to = {(ROOT / path).resolve() for path, _ in links(ROOT / "README.md") if path.endswith("README.md")}
    assert led_to == set(READMES[1:])
    assert len(READMES) == 6


@pytest.mark.parametrize("page", LONGEST_LINES, ids=lambda path: path.name)
def test_pages_that_are_read_as_a_whole_are_short(page):
    assert len(page.read_text().splitlines()) <= LONGEST_LINES[page]
    assert len(page.read_text()) <= 100 * LONGEST_LINES[page]


@each_readme
def test_links_lead_to_files_and_headings(page):
    assert links(page)
    for path, anchor in links(page):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        assert not anchor or anchor in headings(target), f"{path}#{anchor}"


@each_readme
def test_paths_exist(page):
    """Paths from the root, wherever they stand; and names of Python files, which follow a folder in their line."""
    text = page.read_text()
    paths = re.findall(rf"(?<![\w/.:-])((?:{'|'.join(PACKAGES)})/[\w./-]*[\w/])", re.sub(r"\]\([^)]*\)", "]", text))
    assert not [path for path in paths if not (ROOT / path).exists()]
    for line in text.splitlines():
        folders = [ROOT, page.parent]
        for span in re.findall(r"`([\w./]+)`", line):
            if span.endswith("/") and (ROOT / span).is_dir():
                folders.append(ROOT / span)
            elif span.endswith(".py"):
                assert any((folder / span).is_file() for folder in folders), f"{span} in {line}"


@each_readme
def test_a_name_is_in_the_file_that_the_readme_says(page):
    for names, path in re.findall(r"((?:`\w+`(?: and |, )?)+) in\s+\[[^\]]+\]\(([^)]+\.py)\)", page.read_text()):
        for name in re.findall(r"\w+", names.replace(" and ", " ")):
            assert re.search(rf"\b{name}\b", (page.parent / path).read_text()), f"{name} in {path}"


@each_readme
def test_commands_are_understood(page, monkeypatch):
    monkeypatch.chdir(ROOT)  # where a user stands who names a file of the repository
    for line in code_lines(page):
        if line.startswith("shoal "):
            parse(shlex.split(line)[1:])


@each_readme
def test_make_targets_exist(page):
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = re.findall(r"`make ([\w-]+)", page.read_text())
    named += [match[1] for line in code_lines(page) if (match := re.match(r"make ([\w-]+)", line))]
    assert set(named) <= targets
