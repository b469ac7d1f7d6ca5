"""Budgets of `ccdtools.studies`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

MODEL_RUNS = 200  # A deployment logs so many runs by default where the real plant is the model itself.
REAL_RUNS = 500  # The gains on a real plant of short runs are measured on so many of them.
WARM_UP_WINDOWS = 64  # The warm-up is measured on about so many windows.
WARM_UP_DESIGNS = 9  # The warm-up is measured at so many designs of the box.
SET_SECONDS = 3.0  # A set that is only drawn is computed for so long at most [s].
LONGEST_LOG = 200  # A decision on a redesign looks so many deployments ahead at most.
TRIAL_RUNS = 120  # Designs of several uses are tried in so many runs of each, a fifth of them in the quick form.
