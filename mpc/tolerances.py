"""Every tolerance of `mpc`, with its meaning and unit.

"Scaled" means: variables divided by their typical size, rows of unit length, bounds of size about one. A tolerance in
scaled coordinates has no unit and means the same whatever units the user measures in.
"""

from __future__ import annotations

import sys

EPS = sys.float_info.epsilon  # Relative rounding of one operation [-]

# ---- the online QP ----
# Relative optimality residual above which the second solver is asked, at which OSQP stops before it polishes, at which
# a sequence of quadratic programs has come to an optimum, and up to which a piece of an explicit law is accepted; rate,
# beside its parts, at which a row that depends on acting ones leaves its bound by rounding alone [-]
KKT = 1e-7
# Size of terms, in units of their difference, beyond which it has fewer digits than `KKT` asks for [-]: of a feedback
# Kx beside the limits of u = v - Kx, of what an unstable plant makes of costates, and of bounds beside their units
RUNAWAY = KKT / EPS
# Relative optimality residual, or Newton step in units of the limits, above which a plan is INACCURATE; so a row that
# is nearer to its bound, and would be passed by less if it did not act, neither acts nor leaves the plan alone [-]
KKT_REPORTED = 1e-6
# What counts as none on scaled data [-]: a violation of a row (DAQP accepts it; a row that cuts no deeper into the set
# of the others is redundant; a box or a region that reaches no further across a side does not cross it), a gap between
# opposite rows, a step of Newton's method, a normal of a law, a coefficient, a multiplier beside the largest, a
# difference of laws, a part of a row outside the span of those that act
PRIMAL = 1e-9
# Residuals on scaled data at which HiGHS, Clarabel and, at a steady state, Ipopt stop, and multiplier of a proof of
# infeasibility above which its row takes part [-]: the least that HiGHS allows
SOLVERS = 1e-10
LP_OPTIONS = {"primal_feasibility_tolerance": SOLVERS, "dual_feasibility_tolerance": SOLVERS}
# Violation, relative to the unit of its row, up to which a problem counts as feasible [-]: that which a plan may have,
# well above what the LP and QP solvers themselves accept on scaled rows
FEASIBLE = KKT_REPORTED
NO_BOUND = 1e30  # DAQP takes this bound for none, and scaled parameters of a law are cut off there [-].
# Part of the bounds below which forces and steps count as zero in the residuals, part of an extent, of a size or of the
# largest change below which a bound, an unknown, a state or a change says nothing of sizes, and weight of an aim that
# only settles what the others leave open [-]
NEGLIGIBLE = 1e-6
# Part of the terms of a sum that is rounding [-]: of bounds along an axis, costs of a mode, coefficients of laws and
# rows, rates along a unit row, a row at a projected point, a residual or slack of a row, a feedback, a closed loop's
# distance from the unit circle, an eigenvalue of a matrix with unit diagonal, what is added to a unit diagonal that may
# be singular, the squared distance of a unit row of the QP of least violation from the span of others
ROUNDED_SUM = 1e-13

# ---- sets ----
# Entries of the QP beyond which nothing is computed: such data are answered by the saturated regulator
OVERFLOW = 1e100

# ---- unstable plants ----
# Growth of A^k over the horizon from which on the free variable is the deviation from a stabilising feedback [-]
GROWTH = 1e3

# ---- relaxation ----
# Weights of the control cost beside the squared violation [-], tried in turn until the QP solves accurately
RELAXATION_SHARES = (1e-6, 1e-3, 1.0)
RELAXATION_MARGIN = 1e-8  # Room that relaxed bounds leave, relative to the bound or to the slack [-]
# Further room tried in turn where the QP with the least relaxation is called infeasible, in units of the rows [-]
RELAXATION_WIDER = (0.0, 1e-6, 1e-4, 1e-2)

# ---- regulator ----
# Relative distance to a pair that does not reach or see a mode below which it counts as not reached or unseen, and
# inverse of how many times further than the plant a feedback may move the states [-]
REACH = 1e-7
# Distance from the unit circle up to which a mode neither grows nor decays within what is computed [-]
NEAR_CIRCLE = 1e-6
# Last Newton step of the Riccati equation that is accepted, in units in which the solution has a unit diagonal [-]
RICCATI = 1e-4
# Last relative change of the distance of the closed loop from the unit circle that is accepted [-]
SETTLED_MARGIN = 0.1

# ---- explained infeasibility ----
STEADY = 1e-9  # Residual of the steady-state equation, relative to its terms or sizes, that counts as none [-]

# ---- stage-by-stage solution, in scaled variables ----
FIRST_GUESS_SHARE = 0.9  # Share of the limits that a first guess of the inputs uses [-]

# ---- targets ----
TARGET_COST = 1e-8  # Weight of the cost beside the squared output error, both of unit size, which settles ties [-]

# ---- sensitivities ----
# First Newton step from a plan, in sizes of inputs and states, or from parameters, in their deviations, beyond which
# these are no optimum; part of a deviation by which parameters are moved for slopes of their likelihood [-]
NEAR_OPTIMUM = 1e-2

# ---- explicit laws: the multiparametric QP in scaled coordinates (unit rows, parameters in [-1, 1]) ----
# Squared distance of a unit row from the span of others below which it depends on them, and no projection moves along
# it [-]
DEPENDENT_ROW = 1e-12
# Squared distance of a unit row from the span of others below which rounding, which it magnifies, is not none: then
# multipliers are refined by their residual, and laws computed by orthogonal directions [-]
REFINED_ROW = ROUNDED_SUM / PRIMAL
# Size of the variables, in units of the largest bound, up to which a proof of infeasibility holds though its rows are
# rounded; and the largest such unit, in units of the bounds [-]
EXCLUDED = PRIMAL / ROUNDED_SUM
# Distance of the unconstrained optimum from the bounds, in units of their size, beyond which rounding decides which
# rows hold with equality and which lie in front of others [-]: the problem is a linear program but for its last digits;
# distance of an optimal trajectory from its guess, in their sizes, beyond which it is looked for farther still
FAR_OPTIMUM = 1e8
# Largest slack of a row over a set without interior below which the row holds with equality [-]
IMPLIED_EQUALITY = 1e-8
# Size of a bound, in units of the distance to the unconstrained optimum, from which on it is never met [-]
NOT_NEAR = 10.0
CROSSING = 1e-5  # Distance behind a facet at which the QP is solved to find the neighbour, scaled parameters [-]
# Radius of the ball found in a region below which the region is thinner than CROSSING, scaled parameters [-]: the ball
# is within a factor 20 of the largest. Also the distance from the regions up to which a feasible parameter makes no
# hole.
THIN = 1e-6
# Shift of the bounds that decides between active sets which are optimal together, in units of the bounds [-]
TIE = 1e-8

# ---- explicit laws: point location ----
# Distance outside a region, scaled parameters, at which a parameter still counts as inside [-]; so a region of a lesser
# radius is flat, and two facets that are nearer lie on one hyperplane
INSIDE = 1e-7
INSIDE_FLOAT = 1e-5  # Distance `INSIDE` in generated code of single precision [-]
SAME_HYPERPLANE_DIGITS = 8  # Decimal digits in which unit normals and offsets of rows agree that are one

# ---- optimal control: solving ----
OPTIMAL = 1e-5  # Residual of the optimality conditions, relative to the multipliers or terms, of an optimum [-]
WELL_SIZED = 10.0  # Ratio of sizes found to sizes assumed up to which no solve is repeated [-]
# Negative cost, in sizes of the cost at the guess, and scaled unknown from which on they have no bound [-]
BOTTOMLESS = 1e12
IN_THE_WAY = 0.01  # Part of the largest multiplier from which on a limit is named as one that stands in the way [-]
# Distance from a bound, in sizes or ranges of the unknown, up to which a value is at it [-]: Ipopt moves bounds by 1e-8
AT_BOUND = 1e-6
SHORTEST_DURATION = 1e-4  # Part of its lower bound within which a duration counts as shortest [-]

# ---- optimal control: meshes ----
LIMIT_PASSED = 1e-5  # Relative violation of a limit between the points that a solution may have [-]
COARSE_MESH = 0.05  # Relative error of the dynamics over an interval that a solution may have [-]
COST_ERROR = 0.003  # Estimated relative error of the cost that a solution may have; the true one is up to thrice it [-]
# Error or gain of the cost, difference from a reference, and spread of equal costs, which so has a slope, in sizes of
# the cost or of its slope, that is rounding [-]
COST_ROUNDING = 1e-6
LEAST_MOVE = 0.01  # Least extent of what moves, and of a limit between the points, beside its size [-]
JUMP_PLACE = 0.1  # Precision to which the place of a jump is known, in roots of the tolerance [-]
JUMP_SHARE = 0.5  # Part of an input's range that, crossed within one interval, makes a jump [-]
LEAST_INTERVAL = 1e-9  # Part of the phase below which no interval is cut [-]
SHARPER = 1e-3  # Factor of the solver's tolerance where inputs may jump: short intervals weigh little in the cost [-]
MESH_GAIN = 0.8  # Part of what the mesh before missed below which a finer mesh has helped [-]
JUMPED_LIMIT = 1e-2  # Relative violation that a finer mesh does not lower where the trajectory jumps over a limit [-]

# ---- optimal control: sensitivities of a solution ----
BARRIER_BLUR = 10.0  # Multiple of an interior point's residue within which a bound and its multiplier may be 0 [-]
LEAST_CURVATURE = 1e-3  # Least curvature of an unknown, beside the largest [-]

# ---- parameter estimation ----
# Singular value of the information, beside the largest, below which the data tell nothing of a combination [-]
TOLD_APART = 1e-8
# Standard deviation of a combination, in sizes of the parameters, above which the data leave it open [-]
TOLD = 1.0
NAMED_SHARE = 0.1  # Part of the largest share in a combination below which a parameter is not named [-]
SUPPOSED_NOISE = 0.01  # Deviation of unknown noise, beside that of the outputs, before it is estimated [-]

# ---- nonlinear MPC ----
VIOLATION_PRICE = 100.0  # Price of violating a hard limit by one unit, in costs of the first plan [-]
TARGET_STEADY = 1e-8  # Drift of a target, in sizes of the states, up to which it is steady [-]
