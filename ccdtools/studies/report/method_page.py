"""Table, picture and page of a comparison of methods."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from ccdtools import figure_style as style
from ccdtools.exceptions import InputError
from ccdtools.jobs import held_back
from ccdtools.studies.run_folder import RunFolder

TABLE, PICTURE, PAGE = "methods.csv", "methods.png", "methods.html"
LOOK = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:75em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}"
    "th,td{padding:.3em .7em;text-align:left;border-bottom:1px solid #ddd}th{border-bottom:2px solid #888}"
    "img{max-width:100%}div{overflow-x:auto}"
)


def write_table(found: Any, folder: RunFolder) -> None:
    """Write methods.csv of a `MethodComparison`, making the folder if missing."""
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--output", f"{folder.path} ({error.strerror})", "a folder that can be made") from None
    with held_back(), folder.writing("--output"):  # half a table would be of fewer methods than have ended
        found.to_csv(folder.path / TABLE)
        for name in (PICTURE, PAGE):  # of another table
            (folder.path / name).unlink(missing_ok=True)


def write_methods(title: str, found: Any, folder: RunFolder) -> Path:
    """Write methods.csv, methods.png and methods.html; return the page's path."""
    write_table(found, folder)
    image = style.png(found.plot())
    folder.write_bytes(PICTURE, image)
    said = "".join(f"<li>{escape(line)}</li>" for line in found.verdict)
    body = f"<div>{found.printed.html}</div><ul>{said}</ul>"
    page = page_of(f"{title}: every way to co-design", body, image, "Return against time, and the designs")
    return folder.write_text(PAGE, page)


def page_of(title: str, body: str, image: bytes, alt: str) -> str:
    """Page in HTML with a picture at its end."""
    picture = base64.b64encode(image).decode("ascii")
    name = escape(title)
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{name}</title><style>{LOOK}</style></head>"
        f"<body><h1>{name}</h1>{body}<img alt='{alt}' src='data:image/png;base64,{picture}'></body></html>"
    )
