"""Figure of the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """Figure with file name, title and caption."""

    name: str
    title: str
    caption: str
    figure: Figure
