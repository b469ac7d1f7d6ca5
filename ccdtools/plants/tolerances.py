"""Tolerances of `ccdtools.plants`, relative [-] without a unit."""

# --- allowed designs --------------------------------------------------------------------------------------------------
ON_BOUND = 1e-9  # A design is on a bound, and a number whole, if this close: part of the range, or of one.
SAME_DESIGN = 1e-3  # Two designs are one if they differ by less than this part of the range of every parameter.
FEASIBLE = 1e-6  # A design keeps a constraint up to this violation, as `DesignSpace.violation` has it.
EXACT = 1e-10  # A violation this small, see `UnitConstraints.violation`, is rounding; searches keep as far inside.
EXTENT_QUANTILES = (0.05, 0.95)  # The size of a constraint is that between these quantiles over the box, without poles.
ON_EDGE = 1e-7  # A constraint whose edge is closer than this in the unit box may be active at a design.
NEAR_EDGE = 1e-3  # Samples closer to an edge than this in the unit box say nothing of a constraint's size about it.
BESIDE_LEVEL = 1e-6  # Where a constraint is level on its edge, its normal is taken so far beside it in the unit box.
LEVEL = 1e-12  # A constraint is level where its slope is below this part of its value.
CURVED = 0.1  # Constraints' curvature is left out where that of the distance along them would fall below this.
NEAREST = 1e-5  # A point is the nearest if its distance has at most this part along the constraints.

# --- discretisation ---------------------------------------------------------------------------------------------------
ACCURACY = 1e-6  # By default a step is accurate to this part of half the range of each state, a sample.
STAGES = 3  # Radau collocation has so many stages.
CLOSE = 1e-7  # A Newton step below this part of a state's size is followed by one last, which doubles the digits.
STALLED = 1e-9  # A Newton step below this part of a state's extent that no longer shrinks is what rounding leaves.
CONVERGED = 1e-13  # CasADi's own Newton solver stops at this residual and step, in extents of the states.
TAYLOR_DEGREE = 14  # The series of ‖M‖₁ ≤ 1/2 ends at this degree: the next term is (1/2)¹⁵/15! ≈ 2e-17.
AROUND_WORST = 0.15  # The second round stays within this part of every range, the third within its square.
# The stated error is this multiple of the largest seen: 16/15 if smooth, 2 with a kink, and what was missed.
SAFETY = 3.0
RESOLVED_SHARE = 0.8  # Oscillations above this part of half the sampling rate have under 2.5 samples a period.

# --- jumps of the dynamics --------------------------------------------------------------------------------------------
# Without limits jumps are looked for between points of these sizes.
JUMP_SIZES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1000.0)
JUMP_WIDTH = 1e-6  # A jump is most of what changes over this part of a line, a kink is not.
AT_POINT = 1e-9  # A jump is at a point if it is closer than this part of the point.
NO_JUMP = 1e-12  # A change below this part of the largest rates is no jump.

# --- equilibria and models --------------------------------------------------------------------------------------------
MODEL_AT_REST = 1e-9  # A model is at rest if it moves by less than this part of what a state or input of size one does.
RATE_ROUNDING = 1e-9  # At rest a rate is left with this part of the terms that it is the sum of.
DEPENDENT_PIVOT = 1e-9  # A row or column of the Jacobian below this part of the largest pivot says nothing new.
# Stations, with Newton steps at each, are tried in this order.
PATHS = ((1, 0), (1, 1), (1, 2), (1, 4), *((n, 2) for n in (2, 4, 8, 16, 32, 64)))
SAME_REST = 1e-3  # Two ways end at one rest if they end nearer than this part of an entry's largest value.
SIMULATED_STEP = 1e-3  # Differences of a simulator step by this part of X, U and the box of designs, and by twice it.
