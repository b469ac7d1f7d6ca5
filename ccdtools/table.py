"""A table of text cells, as it is printed or put on a page; and rows of values as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

Line = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Lines of cells below a head. A line may end before the head does, and its last cell then runs on."""

    head: Line
    lines: Sequence[Line]
    right: frozenset[int] = frozenset()  # columns of numbers, which stand to the right

    @property
    def widths(self) -> list[int]:
        """The widest cell of every column, in characters."""
        whole = [line for line in (self.head, *self.lines) if len(line) == len(self.head)]
        return [max(map(len, column)) for column in zip(*whole)]

    def aligned(self) -> list[str]:
        """The head and every line, in columns."""
        places = [f"{'>' if i in self.right else '<'}{wide}" for i, wide in enumerate(self.widths)]
        return [
            "  ".join(format(cell, place) for cell, place in zip(line, places)).rstrip()
            for line in (self.head, *self.lines)
        ]

    @property
    def markdown(self) -> str:
        """The table for a page in Markdown."""
        lines = [self.head, ("---",) * len(self.head), *map(self._filled, self.lines)]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    @property
    def html(self) -> str:
        """The table for a page in HTML."""
        body = "".join(f"<tr>{_row('td', self._filled(line))}</tr>" for line in self.lines)
        return f"<table><tr>{_row('th', self.head)}</tr>{body}</table>"

    def _filled(self, line: Line) -> Line:
        """A line with empty cells up to the end of the head."""
        return line + ("",) * (len(self.head) - len(line))


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV text, a column for every name that occurs."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _row(kind: str, line: Line) -> str:
    """The cells of a row in HTML, of the kind th or td."""
    return "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in line)
