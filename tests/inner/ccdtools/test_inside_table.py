"""A table of text: the same cells in columns, in Markdown, in HTML and as CSV."""

import csv
import html
import io
import re

from ccdtools.table import Table, csv_text

TABLE = Table(
    ("method", "return", "status"),
    [("LQR", "-1.5", "converged"), ("a & b < c", "-10.25", ""), ("MPC", "refused: no linear model of <this>")],
    right=frozenset({1}),
)


def test_columns_are_as_wide_as_their_widest_cell_and_a_line_that_ends_early_widens_none():
    assert TABLE.aligned() == [
        "method     return  status",
        "LQR          -1.5  converged",
        "a & b < c  -10.25",
        "MPC        refused: no linear model of <this>",
    ]
    assert TABLE.widths == [9, 6, 9]


def test_a_page_holds_the_same_cells_as_the_columns():
    filled = [list(TABLE.head), *(list(line) + [""] * (3 - len(line)) for line in TABLE.lines)]
    rows = re.findall(r"<tr>(.*?)</tr>", TABLE.html)
    assert [[html.unescape(cell) for cell in re.findall(r"<t[hd]>(.*?)</t[hd]>", row)] for row in rows] == filled
    lines = TABLE.markdown.splitlines()
    assert [[cell.strip() for cell in line.split("|")[1:-1]] for line in (lines[0], *lines[2:])] == filled
    assert lines[1] == "| --- | --- | --- |"


def test_rows_of_several_kinds_have_a_column_for_every_name_that_occurs():
    text = csv_text([{"a": 1, "b": "x, y"}, {"a": 2, "c": "two\nlines"}])
    assert list(csv.DictReader(io.StringIO(text, newline=""))) == [
        {"a": "1", "b": "x, y", "c": ""},
        {"a": "2", "b": "", "c": "two\nlines"},
    ]
