"""Pages in HTML of tables, sentences and pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

LOOK = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:75em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}"
    "th,td{padding:.3em .7em;text-align:left;border-bottom:1px solid #ddd}th{border-bottom:2px solid #888}"
    "img{max-width:100%}div{overflow-x:auto}"
)


def page_of(title: str, body: str) -> str:
    """Page of a title, as its heading too, and a body in HTML."""
    name = escape(title)
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{name}</title><style>{LOOK}</style></head>"
        f"<body><h1>{name}</h1>{body}</body></html>"
    )


def picture_of(image: bytes, alt: str) -> str:
    """PNG file within a page, with what it shows in words."""
    return f"<img alt='{escape(alt)}' src='data:image/png;base64,{base64.b64encode(image).decode('ascii')}'>"


def paragraphs(lines: Sequence[str]) -> str:
    """Lines of text as paragraphs."""
    return "".join(f"<p>{escape(line)}</p>" for line in lines)
