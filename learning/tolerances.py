"""Tolerances of `learning`, relative [-] without a unit."""

ROUNDING = 1e-9  # A column is constant if its spread is below this part of its size: networks work in single precision.
LOG_STD = (-7.0, 1.0)  # The logarithm of the exploration [-] that a network of its own gives lies in this range.
LEAK = 0.01  # While cloning, the clip keeps this slope outside its range, so that a saturated output can come back.
