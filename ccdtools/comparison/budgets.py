"""Amounts of work of `ccdtools.comparison`."""

FEWEST_TRIMMED = 4  # Of fewer values nothing is trimmed from either end, and the middle half is no other mean.
TIMED_CALLS = 100  # So many calls of a controller are timed, at the first states of a run.
