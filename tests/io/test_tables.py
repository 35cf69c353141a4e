"""Tables at any width: nothing is cut, broken or dropped; tables in notebooks."""

import contextlib
import io
import json
import re

import pytest
from rich.console import Console
from typer.testing import CliRunner

from sme_registry.cli import app
from sme_registry.io.markup import Table, card, folded, pairs_html, table_html
from sme_registry.io.terminal import failure, out, print_json, print_pairs

WIDTHS = (60, 80, 200)
COLUMNS = {"id": "name", "n": "number", "of all": "number", "about it": "text"}
ROWS = [
    ("SME/Default-v1", "1", "12,345", "paper axis-action_dim"),
    ("SME/ALongNameThatNobodyMayCut-v1", "10", "0.125 (0.100 to 0.150)", "word " * 30),
    ("[bold]SME/Empty-v1[/]", "100", "", ""),
]


def printed(table, width):
    """The lines on a terminal of this width, or in a pipe."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        if width is None:
            out().print(table)
        else:
            Console(file=text, width=width, force_terminal=True, color_system=None).print(table)
    return text.getvalue().splitlines()


def words(lines):
    return f" {' '.join(re.sub('[│┃]', ' ', ' '.join(lines)).split())} "


@pytest.mark.parametrize("width", [40, *WIDTHS, None])
def test_every_cell_is_whole_at_every_width(width):
    lines = printed(Table("A title", COLUMNS, ROWS, caption="A caption"), width)
    shown = words(lines)
    assert "…" not in shown
    assert width is None or max(map(len, lines)) <= width
    cells = [re.sub(r"\[.*?\]", "", cell) for row in ROWS for cell in row]
    for word in " ".join((*list(COLUMNS)[1:], *cells)).split():
        assert f" {word} " in shown
    assert shown.count(" word") == 30
    assert lines[0].strip() == "A title"
    assert lines[-1].strip() == "A caption"


def test_sections_and_missing_cells_are_kept():
    table = Table("", {"": "name", "a": "number"})
    table.add_row("heading", style="italic")
    table.add_section()
    table.add_row("x", "1")
    assert printed(table, None) == ["         a", "heading", "x        1"]
    assert any("├" in line for line in printed(table, 60))
    lines = printed(Table("", COLUMNS, ROWS), None)  # in a pipe each row is one line
    assert len(lines) == 1 + len(ROWS)
    assert lines[1].split("  ")[-1] == "paper axis-action_dim"
    assert not any(line.endswith(" ") for line in lines)
    assert not any(sign in "".join(lines) for sign in "│┃━")
    result = CliRunner().invoke(app, ["list", "--kind", "env"], env={"COLUMNS": "20"})
    (row,) = [line for line in result.stdout.splitlines() if "SME/ActionDim1-v1" in line]
    assert row.split()[1:9] == ["1", "8", "1", "1", "1", "0", "0", "100"]
    assert row.endswith("paper axis-action_dim")


@pytest.mark.parametrize(
    "command",
    [
        "show core",
        "study plan smoke",
        "evaluate linear Default --protocol quick-v1",
    ],
)
def test_commands_cut_nothing(command: str) -> None:
    shown = []
    for width in ("1000", "60", "80"):
        settings = {"FORCE_COLOR": "1", "COLUMNS": width}
        result = CliRunner().invoke(app, command.split(), env=settings)
        assert result.exit_code == 0, result.output
        shown.append(re.sub(r"\x1b\[[0-9;]*m", "", result.stdout))
    full = shown[0]
    for narrow in shown[1:]:
        assert narrow.count("…") == full.count("…")
        for number in re.findall(r"(?<![\w.])\d[\d,.]*\d(?![\w.])", full):
            assert number in narrow


BAD = "<script>alert(1)</script>"


def test_every_text_is_escaped():
    table = Table(BAD, {BAD: "name"}, [(BAD,)], caption=BAD)
    html = card(table_html(table), pairs_html(BAD, {BAD: BAD}), folded(BAD, pairs_html("", {})))
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 8


def test_a_long_table_says_how_many_rows_it_leaves_out():
    html = table_html(Table("", {"a": "name"}, [(f"row {i}",) for i in range(2_000)]))
    assert "row 59" in html
    assert "row 60" not in html
    assert "1,940 more" in html


def test_no_text_reaches_a_terminal_with_control_characters(capsys):
    evil = "\x1b[2J\x9b1m\u202ename\x07"
    out().print(Table(evil, {"a": "name", "b": "text"}, [(evil, f"{evil} half ½")], caption=evil))
    print_pairs(evil, {evil: evil})
    failure(f"{evil}\n{evil}")
    print_json({"name": evil, "space": "\u00a0", "tag": "\U000e0001"})
    printed = capsys.readouterr()
    assert all(line.isprintable() for line in (printed.out + printed.err).split("\n"))
    assert "half ½" in printed.out
    for escape in (r"\x1b[2J", r"\x9b1m", r"\u202e"):
        assert escape in printed.out
        assert escape in printed.err
    text = printed.out[printed.out.index("{") :]
    assert json.loads(text) == {"name": evil, "space": "\u00a0", "tag": "\U000e0001"}
