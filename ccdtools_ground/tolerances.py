"""Tolerances of every package's public door, relative [-]."""

# Part of a weight that its user's rounding may be: of its asymmetry beside its largest entry, of a negative eigenvalue
# or a vanishing one beside a unit diagonal
WEIGHT_ROUNDING = 1e-9
