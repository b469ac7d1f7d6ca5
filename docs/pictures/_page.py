"""What the Python blocks of a page leave behind, so that its picture is the one that its code draws."""

import contextlib
import functools
import re
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

DOCS = Path(__file__).parents[1]


@functools.cache
def run(page: str) -> dict[str, Any]:
    """Names that the Python blocks of `page`, a path below docs/, have defined; several pictures share them."""
    text = (DOCS / page).read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # for the files that a page writes
        for block in re.finditer(r"```python\n(.*?)```", text, re.S):
            before = "\n" * text[: block.start()].count("\n")  # an error names the line of the page
            exec(compile(f"{before}\n{block[1]}", page, "exec"), names)
    return names


def save(figure: Any, script: str) -> None:
    """Write the figure beside the script that draws it, and close what is open."""
    figure.savefig(Path(script).with_suffix(".png"), dpi=100)
    plt.close("all")


def table(page: str, first: str) -> list[list[str]]:
    """Cells of the rows below the heading of the table of `page` that begins with the cell `first`."""
    lines = (DOCS / page).read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {first} |".replace("|  |", "| |")))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def number(text: str) -> float:
    """The first number in a cell; NaN where there is none."""
    found = re.search(r"[−+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?", text)
    return float(found[0].replace("−", "-")) if found else float("nan")
