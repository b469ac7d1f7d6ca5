"""Every tolerance of `mpc`, with its meaning and unit.

"Scaled" means: variables divided by their typical size, rows of unit length, bounds of size about one. A tolerance in
scaled coordinates has no unit and means the same whatever units the user measures in.
"""

from __future__ import annotations

# ---- the online QP ----

KKT = 1e-7
"""Relative optimality residual above which the second solver is asked [-]."""

KKT_REPORTED = 1e-6
"""Relative optimality residual above which a plan is INACCURATE [-]."""

PRIMAL = 1e-9
"""Violation of a scaled row that DAQP accepts [-]."""

INTERIOR_POINT = 1e-11
"""Residuals and gap at which Clarabel stops, on scaled data [-]."""

FEASIBLE = 1e-6
"""Violation, relative to the unit of its row, up to which a problem counts as feasible [-]. Well above what the LP and
QP solvers themselves accept on scaled rows (1e-7 and `PRIMAL`), so that their rounding never decides."""

# ---- weights and definiteness ----

ASYMMETRY = 1e-9
"""Largest |W - W'| of a weight, relative to its largest entry [-]."""

NEGATIVE_WEIGHT = 1e-10
"""Negative eigenvalue that a weight with unit diagonal may have by rounding [-]."""

DEFINITE = 1e-13
"""Least eigenvalue of a Hessian with unit diagonal [-]."""
