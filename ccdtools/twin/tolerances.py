"""Tolerances of `ccdtools.twin`, relative [-] unless a unit is named."""

RUNAWAY = 1e3  # Draws are stopped where they exceed this many times the largest logged state.
EXCITED = 0.05  # Least squares leave directions of states and inputs that vary less than this part of the largest.
HELD_OUT = 0.2  # This part of every block of a log is held out by default.
FEWEST_FITTED = 20  # Quantiles, and each unknown of a plant, are fitted to at least so many samples.

RECENT = 20  # So many errors before a window tell how rough it may become.

# --- disturbances that were met --------------------------------------------------------------------------------------
SETTLED_STEP = 1e-9  # A step whose effect is below this part of the error is the last.
# A disturbance whose effect is below this part of its largest in the log is not told from the error, nor a direction of
# E, with columns of length one, that is below this part of its largest singular value.
UNTOLD = 1e-6
TOLD = 0.1  # A disturbance whose effect is above this part of its largest in the log says how large disturbances are.
LARGEST_UNTOLD = 2.0  # No disturbance is larger than this multiple of the largest that is told well.
