"""Tolerances of every package's public door, relative [-]."""

# Part of a weight that its user's rounding may be: of its asymmetry beside its largest entry, of a negative eigenvalue
# or a vanishing one beside a unit diagonal
WEIGHT_ROUNDING = 1e-9

# ---- algebraic variables ----
NEWTON_STEPS = 12  # Newton steps from the guess to an algebraic variable.
ROOT_ROUNDINGS = 100  # Roundings of the largest term, above which a residual is no zero.
SINGULAR = 1e-12  # Least singular value of ∂g/∂z, rows and columns of unit size, that is not rounding [-].
