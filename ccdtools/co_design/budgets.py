"""Budgets of `ccdtools.co_design`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

# --- what a slope or a gain may say -----------------------------------------------------------------------------------
FEW_PARAMETERS = 6  # For at most so many parameters differences may take the place of the gradient through the model.

RANGE_POINTS = 256  # The range of outputs is that at so many states in X.
SEEN_RUNS = 64  # The states that normalise a policy are those of so many episodes of 100 steps.
LITTLE_EXPLORATION = 0.02  # A policy that no PPO trains explores so much, in parts of half the input's range.

# --- state limits and their multipliers -------------------------------------------------------------------------------
MPC_RUNS = 32  # Violation and return of MPC are measured on so many episodes of 100 steps.
ROUNDS_WITHOUT_GAIN = 2  # The rounds end after so many without a gain at designs that keep the limits.
ROUNDS_AT_ONE_DESIGN = 6  # The rounds end after so many at one design that does not keep the limits.

# --- costs in searches ------------------------------------------------------------------------------------------------
SIZE_EVALUATIONS = 20  # The first evaluations of a global search, so many, say how large costs are.
POLICY_ITERATIONS = 40  # A policy is trained so many iterations at every design.
# So many blocks without a gain end an ascent; what PPO gains in one is often chance.
QUIET_BLOCKS = {"pathwise": 1, "ppo": 3, "pathwise+ppo": 1}
QUIET_BLOCKS_LIMITED = 3  # So many blocks without a gain end it while multipliers of the state limits move.

# --- starts and the landscape -----------------------------------------------------------------------------------------
MAP_POINTS = {1: 32, 2: 64, 3: 128}  # The first map has so many designs, by the number of parameters.
MOST_CLIMBED = 6  # At most so many local optima of the first map are climbed.
CLIMBED_COMBINATIONS = 8  # The best combinations of whole numbers, so many, are climbed with.

# --- the expert and its sets ------------------------------------------------------------------------------------------
SET_SECONDS = 60.0  # The invariant set of a design has this time [s]; what is invariant by then is taken.
SET_WORK = 50_000  # A usual processor does so many steps times squared facets in a second, or more.
FEWEST_DESIGNS = 64  # Candidates share at least so many designs.
ABORT = 4.0  # After this multiple of the limit, in processor time, no further set is computed.
VISITS = (0, 1, 2, 4, 8, 16, 32, 64)  # The states after so many steps of each closed loop join the data.
VALUE_TAIL = 400  # Values look ahead so many further steps; 0.99⁴⁰⁰ = 2 %, and the rest is extrapolated.
LONGEST_PLAN = 100  # A plan that a first policy imitates looks ahead at most so many steps.
CANDIDATES_PER_START = 4  # One loop in so many candidates begins where the episodes begin.

# --- episodes and previews --------------------------------------------------------------------------------------------
LONGEST_SEGMENT = 100  # The intermediate values of so many steps are held at once.
HELD_SAMPLES = 256 * 2 * LONGEST_SEGMENT  # All runs together may hold so many samples, however many steps.
DEPTH_TIME = {"time_limit": 2.0}  # One program has this time [s]; where it is not enough, nothing is claimed.

# --- entries of the design without effect -----------------------------------------------------------------------------
TERM_POINTS = (8, 500)  # A term is evaluated at so many points, a few, and where nothing changes many.
DISTURBED_RUNS = 20  # So many scenarios tell a disturbance that is always zero.

# --- a fit, a controller given, and the settling baseline -------------------------------------------------------------
# Nested LQR and checks of a policy have so many scenarios of 100 steps, its gradient twice as many.
SETTLING_RUNS = 256
