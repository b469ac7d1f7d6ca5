"""Tolerances of this folder's modules, relative [-] without a unit."""

ON_LIMIT = 1e-9  # A point that is outside a limit by this part of the half-width is on it.
# Bounds of actions, and inputs at a bound, may miss it by this part of the range or half-width of U: float32 rounds.
SAME_BOUNDS = 1e-5
FLAT_ROW = 1e-9  # A width of X along a row, or a term of a row, is none below this part of the largest over the box.
FURTHER_OUTSIDE = 0.01  # Smaller differences of the peak, in half-widths, or of the part of states outside are ignored.
FURTHER_OUTSIDE_PART = 0.05  # Differences below this part of the other controller's violation are ignored.
DIVERGENCE = 1e3  # A run is lost when a state exceeds this many half-widths of X.
DIVERGENCE_LIMIT = (
    1e6  # A run has diverged beyond this, in sizes of first states, where neither a limit nor X is given.
)
CHANGED_INPUT = 1e-9  # An input moved by less than this part of the range of U was let through as it was.
DESIGN_RANGE = 1.05  # Designs may lie this far out, in half-widths of the range that an agent was made for.

# --- statistics ------------------------------------------------------------------------------------------------------
COSINES = 4  # The variance at frequency zero is estimated from so many frequencies, the degrees of Student's t.
INDEPENDENCE_LEVEL = 0.99  # The test that the parts of a series are independent has this one-sided level.
TRANSIENT = 0.05  # This first part of a series counts in the mean but not in its variance, as a transient is no noise.
FEWEST_RUNS = 10  # Fewer runs, or seeds, decide on no 95 % interval of what is skewed.
SAME_RETURN = 1e-6  # Differences below this part of a return are rounding and the tolerances of solvers.
FEWEST_PAIRS = 20  # Of fewer pairs of blocks nothing is decided, as their correlation cannot be told.
CALIBRATION_BLOCKS = 300  # A drift is told by ranks among so many blocks, a fifth of which turn the features.
SLOWER_DEPENDENCE = 2.0  # Residuals depend on each other so many times as much as neighbouring blocks tell.
NO_RESIDUAL = 1e-6  # A residual below this part of the largest direction's is none.
NOT_WORSE = 0.005  # A loss or a change below this part of the size of a return or a metric does not matter.
