"""A figure as the report shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """Figure with its file name, title and the sentence that says what to see."""

    name: str
    title: str
    caption: str
    figure: Figure
