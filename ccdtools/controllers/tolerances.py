"""Tolerances of `ccdtools.controllers`, relative [-] unless a unit is named."""

CHANGED_INPUT = 1e-9  # An input moved by less than this part of the range of U was let through as it was.
DESIGN_RANGE = 1.05  # Designs may lie this far out, in half-widths of the range that the agent was made for.
