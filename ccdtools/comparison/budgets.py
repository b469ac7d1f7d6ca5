"""Amounts of work of `ccdtools.comparison`."""

PROBES = 16  # From so many states, by as many inputs, a plant is asked whether it is still the same.
TIMED_CALLS = 100  # So many calls of a controller are timed, at the first states of a run.
