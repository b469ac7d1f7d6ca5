"""Budgets of `ccdtools.plants`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

# --- allowed designs --------------------------------------------------------------------------------------------------
BOX_SAMPLES = 256  # A box of designs is searched at so many points of a Sobol sequence, beside centre and corners.
MAX_CORNERS = 10  # Every combination of the bounds of at most so many parameters is tried.
ALLOWED_STARTS = 8  # A search for one allowed point, or for the nearest, has so many starts.
TRIED_COMBINATIONS = 100  # So many combinations of whole numbers are tried, the nearest first.

# --- discretisation ---------------------------------------------------------------------------------------------------
PART_BY_COLLOCATION = 60  # A part by collocation takes about as long as so many of Runge–Kutta.
DEAR_PARTS = 100  # From more Runge–Kutta parts a sample on, their cost is warned of.
# A sample is cut into at most so many parts.
MOST_PARTS = {"rk4": 512, "collocation": 64}
NEWTON_ITERATIONS = 50  # Newton's method has at most so many iterations.
ERROR_POINTS = 1024  # A round of the search for the largest error has so many points over limits and designs.
RUNS_AT_ONCE = 2048  # The numbers of so many runs fit into the processor's cache.
FEW_ROWS = 192  # Up to so many rows CasADi's machine is the faster one; they are even at 200 to 300.
COMPILED_FROM = 3_000_000  # From so many samples of runs on, a step earns the seconds that compiling it takes.
KEPT_SIZES = 16  # A function is held ready for so many numbers of rows.
EVENT_ROUNDS = 100  # An FMU may update its discrete states so many times before its first step.

# --- jumps of the dynamics --------------------------------------------------------------------------------------------
JUMP_LINES = 64  # Each size has so many lines; within limits they are a multiple of it.
