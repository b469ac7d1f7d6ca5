"""Budgets of `ccdtools.vehicles`: what an answer may cost. None of them judges it."""

TUNING_EVALUATIONS = 30  # A damper's law is tuned by so many evaluations for each of its gains,
TUNING_RUNS = 32  # of so many runs each.
