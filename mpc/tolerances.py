"""Every tolerance of `mpc`, with its meaning and unit.

"Scaled" means: variables divided by their typical size, rows of unit length, bounds of size about one. A tolerance in
scaled coordinates has no unit and means the same whatever units the user measures in.
"""

from __future__ import annotations

# ---- the online QP ----
KKT = 1e-7  # Relative optimality residual above which the second solver is asked [-]
KKT_REPORTED = 1e-6  # Relative optimality residual above which a plan is INACCURATE [-]
PRIMAL = 1e-9  # Violation of a scaled row that DAQP accepts [-]
INTERIOR_POINT = 1e-11  # Residuals and gap at which Clarabel stops, on scaled data [-]
# Absolute and relative tolerance at which OSQP stops, on scaled data; its answer is polished afterwards [-]
OSQP = 1e-7
# Violation, relative to the unit of its row, up to which a problem counts as feasible [-]. Well above what the LP and
# QP solvers themselves accept on scaled rows (1e-7 and `PRIMAL`), so that their rounding never decides.
FEASIBLE = 1e-6
UNREACHED = 1e-9  # Violation of a row that no input reaches, in its unit, that is put down to rounding [-]
# Scaled violations of the origin are at most the inverse of this: with larger ones `PRIMAL` would lie below rounding
# [-]
FAR_BOUND = 1e-7
NEGLIGIBLE = 1e-6  # Part of the bounds below which forces and steps count as zero in the residuals [-]

# ---- weights and definiteness ----
ASYMMETRY = 1e-9  # Largest |W - W'| of a weight, relative to its largest entry [-]
NEGATIVE_WEIGHT = 1e-10  # Negative eigenvalue that a weight with unit diagonal may have by rounding [-]
DEFINITE = 1e-13  # Least eigenvalue of a Hessian with unit diagonal [-]

# ---- sets ----
# By how much the lower side of a box may lie above the upper one through rounding, relative to their size [-]
EMPTY = 1e-9
# Bound, relative to the farthest one along the same axis, below which it is a zero that was rounded [-]
ROUNDED_ZERO = 1e-13
# Part of the size of the states that inputs must at least be able to regulate, to have a size of their own [-]
SMALL_STATE = 1e-3
# Bound of a row, relative to the extent of the set along it, below which that extent is the unit of the row [-]
SMALL_BOUND = 1e-6
FAR = 1e4  # Distance in units of a set beyond which only the direction of a point counts for its projection [-]
# Growth of an unstable plant over the horizon up to which costates keep the digits that a check needs [-]
REMEMBERED = 1e6
# Entries of the QP beyond which nothing is computed: such data are answered by the saturated regulator
OVERFLOW = 1e100

# ---- unstable plants ----
# Growth of A^k over the horizon from which on the free variable is the deviation from a stabilising feedback [-]
GROWTH = 1e3
RUNAWAY = 1e7  # Feedback Kx, in units of the limits of u, beyond which too few digits of u = v - Kx are left [-]

# ---- relaxation ----
# Weights of the control cost beside the squared violation [-], tried in turn until the QP solves accurately
RELAXATION_SHARES = (1e-6, 1e-3, 1.0)
RELAXATION_MARGIN = 1e-8  # Room that relaxed bounds leave, relative to the bound or to the slack [-]
# Further room tried in turn where the QP with the least relaxation is called infeasible, in units of the rows [-]
RELAXATION_WIDER = (0.0, 1e-6, 1e-4, 1e-2)

# ---- regulator ----
# Relative distance to an unstabilisable pair below which a mode counts as not reached, and inverse of how many times
# further than the plant a feedback may move the states [-]
REACH = 1e-7
UNIT_CIRCLE = 1e-9  # Distance inside the unit circle up to which a mode counts as not decaying [-]
# Distance from the unit circle up to which a mode neither grows nor decays within what is computed [-]
NEAR_CIRCLE = 1e-6
# Last Newton step of the Riccati equation that is accepted, in units in which the solution has a unit diagonal [-]
RICCATI = 1e-4
GAINED = 0.1  # Part of its residual that a Newton step must leave to be taken where it may be rounding [-]
# Last relative change of the distance of the closed loop from the unit circle that is accepted [-]
SETTLED_MARGIN = 0.1
# Distance of a closed loop from the unit circle below which rounding decides whether it is stable [-]
LEAST_MARGIN = 1e-13
ROUNDED_COST = 1e-13  # Cost of a mode, relative to the terms that it is the sum of, that is rounding [-]
DOUBLED = 1e-9  # Root of the last term of a sum of doubled terms, relative to that of the sum, that is left out [-]
# Relative distance of (Q, A) from not seeing a mode on the unit circle below which it counts as unseen [-]
UNSEEN = 1e-8

# ---- explained infeasibility ----
LP_FEASIBLE = 1e-10  # Violation of a row, in its unit, that the LP solver accepts [-]; the least that HiGHS allows
LP_SUPPORT = 1e-8  # Violation, in the unit of the row, above which a row is among those that give [-]
# Multiplier of a proof of infeasibility above which its row takes part, and weight of z beside a violation [-]
CERTIFICATE = 1e-12
FARTHEST = 1e12  # Bounds larger than this, relative to their unit, are scaled down for the LP solver [-]
STEADY = 1e-9  # Residual of the steady-state equation, relative to its terms, that counts as none [-]

# ---- stage-by-stage solution, in scaled variables ----
# Largest Newton step of an input, in units of its limits, at which a stagewise plan counts as solved [-]
STAGEWISE = 1e-6
BARRIER_STOP = 1e-9  # Newton step and violation at which the interior-point iteration ends [-]
SLACK_FLOOR = 1e-14  # Least slack of a row in units of its bound: smaller ones are rounding [-]
# Relative rounding of a state that has come about over a whole horizon [-]: its feedback is no more exact
FEEDBACK_ROUNDING = 1e-14
ROUNDING = 1e-15  # Residual of a row, relative to its terms, that is rounding [-]

# ---- targets ----
TARGET_COST = 1e-8  # Weight of the cost beside the squared output error, both of unit size, which settles ties [-]
TARGET_DRIFT = 1e-6  # Weight of the output error beside the squared drift where no state is steady [-]

# ---- sensitivities ----
# Distance from its bound, in its unit, up to which a row of a plan may act [-]: plans are no more exact than
# `KKT_REPORTED`. The Newton steps that follow decide.
ACTIVE = 1e-5
# Distance of a row from its bound, and how far the plan would pass it if it did not act, both in its unit, below which
# it neither acts nor leaves the plan alone [-]: plans are no more exact
WEAKLY_ACTIVE = 1e-6
# First Newton step from a plan, in sizes of inputs and states, beyond which the plan is no optimum [-]
NEAR_OPTIMUM = 1e-2
# Newton step, in sizes of inputs and states, from which on derivatives are taken [-]; their error is of this size
NEWTON = 1e-9
INDEPENDENT = 1e-9  # Part of a row outside the span of the acting ones below which it depends on them [-]
TOGETHER = 1e-7  # Rate at which a dependent row leaves its bound, beside its parts, that is rounding [-]

# ---- explicit laws: the multiparametric QP in scaled coordinates (unit rows, parameters in [-1, 1]) ----
# Width of a parameter's interval, relative to its largest value, below which the parameter set is flat [-]
FLAT_INTERVAL = 1e-9
REGION_RADIUS = 1e-7  # Radius of a ball below which a critical region counts as flat, scaled parameters [-]
SAME_PLANE = 1e-7  # Difference of unit normals and offsets below which two facets lie on the same hyperplane [-]
# Normal of a multiplier or slack law, relative to what the size of the variables allows, below which it is zero [-];
# for its constant, ten times as much
ZERO_ROW = 1e-10
DEPENDENT_ROW = 1e-12  # Squared distance of a unit row from the span of others below which it depends on them [-]
REFINED_ROW = 1e-5  # The same, below which the multipliers are refined by what their rows miss [-]
EXCHANGE = 1e-9  # Least coefficient of a dependent row on a member of the active set that can leave for it [-]
# Size of the variables, in units of the largest bound, up to which a proof of infeasibility holds though its rows are
# rounded; and the largest such unit, in units of the bounds [-]
EXCLUDED = 1e4
# Distance of the unconstrained optimum from the bounds, in units of their size, beyond which rounding decides which
# rows hold with equality and which lie in front of others [-]: the problem is a linear program but for its last digits
FAR_OPTIMUM = 1e8
DUPLICATE = 1e-9  # Difference of two unit rows below which only the tighter of them is kept [-]
EQUALITY = 1e-11  # Distance of two opposite unit rows, in units of the bounds, below which they make an equality [-]
# Largest slack of a row over a set without interior below which the row holds with equality [-]
IMPLIED_EQUALITY = 1e-8
REDUNDANT = 1e-9  # How far a unit row may cut into the set of the others and still count as redundant [-]
# Error of a law, in its active rows, in any row or multiplier at the centre of its region, relative to the bounds, the
# variables or the multipliers, up to which the law is accepted [-]
LAW_ERROR = 1e-7
# Change of a bound by the parameters, relative to the largest such change, that says nothing of sizes [-]
UNCHANGED = 1e-9
# Size of a bound, in units of the distance to the unconstrained optimum, from which on it is never met [-]
NOT_NEAR = 10.0
# Size of a bound, relative to the largest change of a bound by the parameters, that is zero but for rounding [-]
ROUNDED = 1e-12
# Effect of the inputs on a row, relative to that of the parameters, below which the row restricts parameters only
VANISHING_ROW = 1e-14
OPTIMAL_SET = 1e-10  # Violation of a unit row accepted, and relative multiplier dropped, in the QP at one parameter [-]
# The least part of the distance to the bounds that LAW_ERROR of the bounds is taken as [-]: nothing is more exact
LAW_ROUNDING_FAR = 1e-14
# Entry of the inverse of a Gram matrix of unit rows from which on a law is computed by orthogonal directions [-]
NEARLY_DEPENDENT = 1e5
PROJECTION = 1e-13  # Violation of a unit row accepted when a point is projected onto a region, scaled parameters [-]
NO_STEP = 1e-12  # Coefficient of a unit row on the active ones below which it is rounding [-]
# Squared distance of a unit row from the span of the active ones below which a projection cannot move along it [-]
SPANNED = 1e-13
TINY_PIVOT = 1e-30  # Least square of a pivot in a projection: keeps its root away from zero [-]
PARALLEL = 1e-14  # Rate at which a ray nears a unit row below which it runs along it, scaled parameters [-]
# Distances from all constraints tried in turn when a feasible parameter is sought, scaled [-]
INSETS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
CROSSING = 1e-5  # Distance behind a facet at which the QP is solved to find the neighbour, scaled parameters [-]
# Radius of the ball found in a region below which the region is thinner than CROSSING, scaled parameters [-]: the ball
# is within a factor 20 of the largest. Also the distance from the regions up to which a feasible parameter makes no
# hole.
THIN = 1e-6
# Shift of the bounds that decides between active sets which are optimal together, in units of the bounds [-]
TIE = 1e-8

# ---- explicit laws: point location ----
INSIDE = 1e-7  # Distance outside a region, scaled parameters, at which a parameter still counts as inside [-]
INSIDE_FLOAT = 1e-5  # The same in generated code of single precision [-]
SIDE = 1e-9  # How far a region must reach across a hyperplane to lie on that side of it too, scaled parameters [-]
SAME_HYPERPLANE_DIGITS = 8  # Decimal digits in which unit normals and offsets agree that are stored once
# Difference of two laws of one input, relative to the values that input takes, below which they are one [-]
EQUAL_LAW = 1e-9
LAW_ROUNDING = 1e-13  # The same, relative to the largest coefficient of that input: what rounding may change [-]
FAR_AWAY = 4.0  # Distance from the centre, scaled parameters, beyond which only the direction of a parameter counts [-]
