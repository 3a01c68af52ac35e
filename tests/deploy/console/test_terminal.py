"""Text comes out of the terminal as it went in, whatever a path or a name looks like."""

import io
from pathlib import Path

import pytest
from rich.table import Table

from deploy.cli import main
from deploy.console.terminal import plain_console
from deploy.console.training_display import make_display

ODD = ["x[/y]", "[red]x", "[link=http://x]x[/link]", ":warning:", "[/]", r"a\[b]", "[[x]]"]
"""What rich reads as markup that closes or opens, as an emoji, or as an escape, unless it is told not to."""


@pytest.fixture(params=[False, True], ids=["plain", "terminal"])
def console(request):
    return plain_console(file=io.StringIO(), width=200, force_terminal=request.param, color_system=None)


@pytest.mark.parametrize("text", ODD)
def test_a_line_and_a_table_show_text_as_it_is(console, text):
    console.print(text)
    table = Table(title=f"title {text}")
    table.add_column(f"head {text}")
    table.add_row(f"cell {text}")
    console.print(table)
    shown = console.file.getvalue()
    assert shown.startswith(text + "\n")
    for part in (f"title {text}", f"head {text}", f"cell {text}"):
        assert part in shown


@pytest.mark.parametrize("text", ODD)
def test_displays_show_messages_as_they_are(console, text):
    with make_display(console, 10) as display:
        display.message(f"going on from {text}")
    assert f"going on from {text}" in console.file.getvalue()


def test_a_command_with_such_a_path_writes_and_prints_it(tmp_path, capsys):
    out = tmp_path / "x[/y] :boom:" / "[red].html"
    table = Path(__file__).parents[3] / "dashboards" / "results" / "tried" / "unsettled.csv"
    assert main(["dashboard", str(table), "--episodes", "0", "--out", str(out)]) == 0
    assert out.exists()
    assert str(out) in capsys.readouterr().out.splitlines()
