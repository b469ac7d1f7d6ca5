"""Tolerances of `ccdtools.estimation`, all relative [-]."""

SINGULAR = 1e-12  # A covariance of unit diagonal with an eigenvalue below this has a combination without variance.
MOVED_AT_REST = 1e-6  # A sample may add this part of a predicted standard deviation at rest, and still be rounding.
DIFFERENCE_STEP = (2.0**-52) ** (1 / 3)  # Central differences step by this part of the standard deviation of a state.
LEAST_DIFFERENCE_STEP = (2.0**-52) ** (2 / 3)  # Central differences step by at least this part of a state.
MAIN_STATES = 0.5  # States with less than this part of the largest part of a mode are not named.
FLAT_OUTPUT = 1e-9  # Slopes of an output at the estimate below this part of its largest slope at any point are zero.
