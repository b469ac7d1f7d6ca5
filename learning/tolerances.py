"""Tolerances of `learning`, relative [-] without a unit."""

ROUNDING = 1e-9  # A column is constant if its spread is below this part of its size: networks work in single precision.
LOG_STD = (-7.0, 1.0)  # The logarithm of the exploration [-] that a network of its own gives lies in this range.
LEAK = 0.01  # While cloning, the clip keeps this slope outside its range, so that a saturated output can come back.
LEAST_SPREAD = 1e-8  # What is normalised by its standard deviation is divided by this [units of it] or more.
LEAST_PART = 1e-4  # Observations are divided by this part of their mean or more: single precision rounds the mean.
SCALE_MEMORY = 0.1  # A rollout moves the unit of values by this part of the way to its own, or more at first.
WIDEST = 1e6  # A wider range of an observation [its unit] says nothing of its size.
FALSE_ALARM = 1e-4  # A promise that holds is reported as lost in about this part of independent samples.
