"""Budgets of `ccdtools.twin`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

import numpy as np

BLOCKS = 20  # A single long run is cut into so many blocks by default.

# --- disturbances that were met --------------------------------------------------------------------------------------
DERIVATIVES_AT_ONCE = 8192  # Derivatives are computed of so many samples at once: those of long steps fill the memory.

# --- least squares ---------------------------------------------------------------------------------------------------
RIDGES = np.append(np.logspace(-12, 4, 65), np.inf)  # Weights tried, beside the square of the largest singular value

# --- experiments -----------------------------------------------------------------------------------------------------
EXCITATIONS = (0.1, 0.3, 1.0)  # Excitations are tried of these shares of U's half-width.
