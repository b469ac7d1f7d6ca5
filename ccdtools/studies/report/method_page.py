"""Table, picture and page of a comparison of methods."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from ccdtools import figure_style as style
from ccdtools.exceptions import InputError
from ccdtools.jobs import held_back
from ccdtools.pages import page_of, picture_of
from ccdtools.studies.run_folder import RunFolder

TABLE, PICTURE, PAGE = "methods.csv", "methods.png", "methods.html"


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
    picture = picture_of(image, "Return against time, and the designs")
    body = f"<div>{found.printed.html}</div><ul>{said}</ul>{picture}"
    return folder.write_text(PAGE, page_of(f"{title}: every way to co-design", body))
