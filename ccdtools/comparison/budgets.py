"""Amounts of work of `ccdtools.comparison`."""

TIMED_CALLS = 100  # So many calls of a controller are timed, at the first states of a run.
