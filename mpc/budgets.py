"""Budgets of `mpc`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

# ---- the online QP ----
DAQP_ITERATIONS = 10_000  # DAQP stops after so many iterations.
MOST_MATRIX_ENTRIES = 2e8  # A condensed QP with more matrix entries, 1.6 GB, is refused.

# ---- explicit laws: point location ----
POINTS_OF_REGION = 64  # Points that stand for a region at most: as many as a word has bits.
TRIES = 64  # Hyperplanes tried at most at a node before it becomes a leaf
LEAF_ENTRIES = 200  # Entries of leaves, for each region of the partition, at which a tree stops growing
TESTS_AT_ONCE = 20_000  # Regions tested between two looks at the clock

# ---- explicit laws: exploration and the search for holes ----
# Distances from all constraints at which a feasible parameter is sought in turn, scaled parameters [-]
INSETS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
CLEARANCE = 0.1  # A point behind a facet is sought so far from the other facets first, scaled parameters [-].
LAWS_AT_ONCE = 4096  # Laws checked at once, which bounds the memory
POINTS_ANYWHERE = 4  # Random parameters, and as many near the border, at which holes are looked for
POINTS_BETWEEN = 100  # Points between facets at which holes are looked for
POINTS_BEHIND = 500  # Points behind facets that led to a region, at which holes are looked for
FARTHEST_BEHIND = 0.01  # Holes are looked for so far behind a facet at most, scaled parameters [-].
REGIONS_PER_POINT = 8  # Regions of a large law for which each way of looking for holes takes one more point
QPS_AT_ONCE = 16  # Points at which the QP is solved before the others are checked against the new regions

# ---- optimal control: solving ----
USUAL_ITERATIONS = 3000  # Iterations of Ipopt at most, unless the caller says otherwise
LEAST_SECONDS = 1e-3  # Time that a call of the solver is given, however late it is [s]
NAMED_ROWS = 5  # Violated constraints, and others in the way, that are named at most
SHAKEN = 0.3  # A second start is moved by this part of the sizes of unknowns at most [-].
ASIDE = 1e-3  # A start is moved by this part of the sizes of unknowns at most so that it stays on no saddle [-].

# ---- nonlinear MPC ----
PROGRAMS_TO_GO = 8  # Quadratic programs in which the error must be halved, before an interior-point solver is asked

# ---- optimal control: meshes ----
HIGHEST_DEGREE = 50  # Highest degree of collocation: matrices of so many points still have twelve digits.
OBSTACLE_DOUBLINGS = 11  # Doublings of its depth beyond which an obstacle must go on: 1/1000 of a radius [-]
LIMIT_CHECKS = 16  # Places of an interval, and again about each largest violation, at which limits are checked
CLOSER_LOOKS = 5  # A largest violation is looked at so many times, each time eight times as close.
MESH_SAFETY = 0.05  # New intervals aim at this part of the tolerance [-], so that fewer meshes are made.
MOST_PARTS = 6  # Parts at most that an interval is cut into at once
MESHES_WITHOUT_GAIN = 2  # Meshes in a row without a gain, rounding alone, after which none is made
GUESSED_STEPS = 10  # Gauss–Newton steps from outputs to the states that a parameter estimation starts from.

# --- limits tightened for disturbances -------------------------------------------------------------------------------
INPUT_WEIGHTS = tuple(10.0**k for k in range(1, 7))  # Multiples of R of the regulators tried for the tube.
TUBE_STEPS = 300  # Disturbances are followed for so many steps to compare these.
TUBE_TRIALS = 200  # Gains at most that are tried from the best of these.
TUBE_ACCURACY = 1e-3  # Gains are tried until they leave as much of the limits within this part of them [-].
