"""Tables in notebooks: escaped, whole, and not too long."""

from __future__ import annotations

from sme_registry.terminal import Table
from sme_registry.terminal.html import card, folded, pairs_html, table_html

BAD = "<script>alert(1)</script>"


def test_every_text_is_escaped() -> None:
    table = Table(BAD, {BAD: "name"}, [(BAD,)], caption=BAD)
    html = card(table_html(table), pairs_html(BAD, {BAD: BAD}), folded(BAD, pairs_html("", {})))
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 8


def test_a_long_table_says_how_many_rows_it_leaves_out() -> None:
    html = table_html(Table("", {"a": "name"}, [(f"row {i}",) for i in range(2_000)]))
    assert "row 59" in html
    assert "row 60" not in html
    assert "1,940 more" in html
