"""How far a long computation is: a bar on a terminal, a line of text every ten seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

Echo = Callable[[str], None]
Item = TypeVar("Item")
EVERY = 10.0  # seconds between two lines of text


def counted(
    items: Iterable[Item], label: str, *, total: int, progress: bool = False, echo: Echo | None = None
) -> Iterator[Item]:
    """Yield the items, with a bar if `progress`, else with lines through `echo` where it takes long."""
    if progress or echo is None:
        yield from tqdm(items, desc=label, total=total, disable=not progress, leave=False)
        return
    begun = time.perf_counter()
    due = begun + EVERY
    for count, item in enumerate(items):
        now = time.perf_counter()
        if now >= due:
            echo(f"    {label}: {count} of {total} after {now - begun:.0f} s")
            due = now + EVERY
        yield item
