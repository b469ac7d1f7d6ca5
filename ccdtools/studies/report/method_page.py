"""The table and the picture of a comparison of methods, in files and on one self-contained page."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from ccdtools import figure_style as style
from ccdtools.studies.run_folder import RunFolder

LOOK = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:75em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}"
    "th,td{padding:.3em .7em;text-align:left;border-bottom:1px solid #ddd}th{border-bottom:2px solid #888}"
    "img{max-width:100%}div{overflow-x:auto}"
)


def write_methods(title: str, found: Any, folder: RunFolder) -> Path:
    """Write methods.csv, methods.png and methods.html of a `MethodComparison`; the path of the page."""
    found.to_csv(folder.path / "methods.csv")
    image = style.png(found.plot())
    folder.write_bytes("methods.png", image)
    return folder.write_text("methods.html", page(title, found, image))


def page(title: str, found: Any, image: bytes) -> str:
    """The page, its picture within."""
    head, *rows = found.cells()
    table = f"<tr>{_row('th', head)}</tr>" + "".join(f"<tr>{_row('td', row)}</tr>" for row in rows)
    said = "".join(f"<li>{escape(line)}</li>" for line in found.verdict)
    name = escape(title)
    picture = base64.b64encode(image).decode("ascii")
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{name}</title><style>{LOOK}</style></head>"
        f"<body><h1>{name}: every way to co-design</h1><div><table>{table}</table></div><ul>{said}</ul>"
        f"<img alt='Return against time, and the designs' src='data:image/png;base64,{picture}'></body></html>"
    )


def _row(cell: str, values: tuple[str, ...]) -> str:
    """The cells of a row."""
    return "".join(f"<{cell}>{escape(value)}</{cell}>" for value in values)
