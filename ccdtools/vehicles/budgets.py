"""Budgets of `ccdtools.vehicles`: what an answer may cost. None of them judges it."""

SKYHOOK_EVALUATIONS = 60  # Skyhook is tuned by so many evaluations at a design,
SKYHOOK_RUNS = 32  # of so many runs each.
