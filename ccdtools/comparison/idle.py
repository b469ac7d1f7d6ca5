"""Baselines that do nothing."""


def nothing_done(place: str) -> str:
    """Remark on a baseline whose inputs were all 0."""
    return f"does nothing on {place}: all its inputs were 0, so that a gain over it is one over the plant left alone"
