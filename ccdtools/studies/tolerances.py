"""Tolerances of `ccdtools.studies`, relative [-] without a unit."""

from ccdtools.tolerances import NOT_WORSE, SAME_RETURN

MINIMUM_LOG = 500  # A deployment must log so many samples for its quantiles to mean anything.
MOSTLY_OUTSIDE = 0.5  # A recording with a larger part of its samples outside X is not one of this plant.
WORTH_A_POLICY = 0.001  # A policy costs nothing to build and is replaced for a gain of this part of the return.
FALSE_ALARM = 0.002  # A prediction that is right is called wrong with this chance in a generation.
UNATTRIBUTED = 0.1  # A redesign is limited if more than this part of the errors' energy is not known at another design.
FIRST_RADIUS = 0.25  # The first redesign moves a parameter by at most this part of its range.
LEAST_RADIUS = 1 / 64  # The radius is never less than this part of the range.
CONSTANT_E = 1e-9  # E does not change with the design if it differs over the box by less than this part of itself.
SETTLED_START = 0.02  # A start may cost or save this part of the return without the cost of the design.
SMALL_PART = 0.02  # A part of a whole below this goes unmentioned.
NOT_WORSE_PERCENT = 100 * NOT_WORSE  # Smaller differences of the return do not matter [% of |LQR|].
EQUAL_PERCENT = 100 * SAME_RETURN  # Two returns this close differ by rounding and what solvers leave [% of |LQR|].
DIVERGED_RUNS = 0.01  # A design of the landscape is left blank if a larger part of its runs diverges.

# --- steps of the real plant, errors as parts of half the range of a state in X --------------------------------------
WRONG_SAMPLE = 0.1  # A sample may be wrong by this without a warning.
UNSTABLE_SAMPLE = 3.0  # Steps whose error within the middle exceeds this do not follow the plant.
THROWN_OUT = 1e3  # A larger error is that of a disturbance that throws the plant out of X, not that of the steps.
NEAR_MIDDLE = 0.1  # Every step must hold in this part of X around its middle.
