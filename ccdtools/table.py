"""Tables of text cells, and rows of values as CSV."""

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
    """Lines of cells below a head; shorter lines run on."""

    head: Line
    lines: Sequence[Line]
    right: frozenset[int] = frozenset()  # columns of numbers, which stand to the right

    @property
    def widths(self) -> list[int]:
        """Widest cell of every column, in characters."""
        whole = [line for line in (self.head, *self.lines) if len(line) == len(self.head)]
        return [max(map(len, column)) for column in zip(*whole)]

    def aligned(self) -> list[str]:
        """Head and every line, in aligned columns."""
        places = [f"{'>' if i in self.right else '<'}{wide}" for i, wide in enumerate(self.widths)]
        return [
            "  ".join(format(cell, place) for cell, place in zip(line, places)).rstrip()
            for line in (self.head, *self.lines)
        ]

    def __str__(self) -> str:
        """Table in aligned columns."""
        return "\n".join(self.aligned())

    @property
    def markdown(self) -> str:
        """Table in Markdown."""
        lines = [self.head, ("---",) * len(self.head), *map(self._filled, self.lines)]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    @property
    def html(self) -> str:
        """Table in HTML."""
        body = "".join(f"<tr>{_row('td', self._filled(line))}</tr>" for line in self.lines)
        return f"<table><tr>{_row('th', self.head)}</tr>{body}</table>"

    def _filled(self, line: Line) -> Line:
        """Line with empty cells up to the end of the head."""
        return line + ("",) * (len(self.head) - len(line))


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV text, a column per name."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def data_frame(columns: Any, owner: str, instead: str) -> Any:
    """`pandas.DataFrame` of columns or rows.

    Raises
    ------
    ImportError
        If pandas is not installed; it says what the owner has instead.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError(f"{owner} needs pandas: install it with `pip install pandas`, or {instead}") from error
    return pd.DataFrame(columns)


def _row(kind: str, line: Line) -> str:
    """HTML cells of a row, of the kind th or td."""
    return "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in line)
