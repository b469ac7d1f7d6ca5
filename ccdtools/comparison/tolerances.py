"""Tolerances of `ccdtools.comparison`, relative [-] unless a unit is named."""

RECOVERED = 0.05  # A PID that recovers less than this part of what LQR gains over the passive plant is no baseline.
UNSTABLE_COST = 1e12  # A loop that is not stable is given this cost, in units of the return.
