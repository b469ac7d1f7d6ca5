"""Tolerances of `ccdtools.co_design`, relative [-] unless a unit is named."""

from ccdtools.tolerances import NOT_WORSE

# --- what a slope or a gain may say -----------------------------------------------------------------------------------
AGREEING = 0.05  # Slopes that differ by less than this part of themselves agree.
# A slope below this part of the return that control makes, per unit-box length, is without consequence.
LEVEL_SLOPE = 1e-3
SIGNIFICANT = 3.0  # A slope or a difference of more standard errors than this is not chance.
SLOPE_AHEAD = 0.1  # Over this distance in the unit box a slope must predict a gain that matters.
UNRESOLVED_SLOPE = 0.05  # A slope says nothing if its error over `SLOPE_AHEAD` exceeds this part of the return.
# A state is scaled by this part, or more, of what the state that fills its range best fills of it [-]
LEAST_FILL = 0.1
FINER_STEPS = (1e-2, 1e-3, 1e-4, 1e-5)  # Central differences of a return try these half steps in the unit box in turn.
COST_STEP = 1e-4  # Central differences of a cost have this half step in the unit box.
POLICY_STEP = 1e-2  # Differences of a policy have this half step, in parts of what it does.
TRUSTED_SLOPE = 0.2  # Adam does not mind this relative error of a gradient's length and direction.
SAME_SENSITIVITY = 0.1  # The slopes to both sides of an optimum may differ by this part of the slope.
SMALL_SENSITIVITY = 0.01  # They may also differ by this part of the unit box per change of the value by itself.

# --- what is one, on an edge or feasible ------------------------------------------------------------------------------
SAME_PLACE = 0.02  # Designs or starts within this distance in every coordinate of the unit box are one.
ACTIVE = 1e-3  # A constraint whose edge is closer than this in the unit box is active.
AT_BOUND = 1e-9  # A point closer to a bound than this in the unit box is on it.
PULL = 10.0  # A point loses at least ½ · 10 · distance² of the return for its distance from the feasible designs.
DISTANCE_COST = 10.0  # A global search adds this part of the cost per squared distance from the feasible designs.
PSD = 1e-9  # A negative eigenvalue below this part of the largest weight is rounding.
STABLE = 1e-6  # Eigenvalues are stable if they are this far inside the unit circle: a body free to drift is not.

# --- state limits and their multipliers -------------------------------------------------------------------------------
LEAST_TOLERANCE = 0.002  # A tolerance is never less than this part of the states, or this many half-widths.
BESIDE_MPC = 1.25  # The tolerance is this multiple of what MPC violates: a network in its place has a resolution.
MEASURED_NEARBY = 0.1  # A design further away than this in the unit box has MPC measured again.
TOLERANCE_STEP = 0.05  # The change of the tolerance with the design is found by this step in the unit box.
EXCESS_ERRORS = 2.0  # A measure may exceed its tolerance by so many standard errors.
AIMED_SHARE = 0.9  # Multipliers aim at this part of the tolerance, so that some iterates are within.
USED_SHARE = 0.8  # A limit may be active from this part of its tolerance on: multipliers aim at `AIMED_SHARE`.
RESOLVED_VIOLATION = 1e-4  # Smaller violations, in half-widths of X, say nothing of how far the states outside X are.
FIRST_PRICE = 0.02  # Leaving X by as much again as the tolerance first costs this part of the return.
LEAST_PRICE = 0.001  # A smaller multiplier is zero.
GROWTH = 0.4  # A multiplier grows by exp(0.4) at an evaluation where X is left by twice the tolerance.
LARGEST_EXCESS = 1.0  # A multiplier grows no faster where the relative excess is larger than this.
PRICE_GROWTH = 2.0  # A round outside the limits multiplies their price by this, beside its usual growth.
NEGLIGIBLE_GAIN = 1e-3  # A gain of a round below this part of the return that control makes has no consequence.
WORTHWHILE_VIOLATION = 0.9  # A block of iterations was worth it if it leaves at most this part of a violation.
VIOLATION_COST = 0.05  # Exceeding the tolerance by `LEAST_TOLERANCE` costs a global search this part of the cost.
NO_VIOLATION = 1e-5  # A violation is none below this many half-widths, the linear program's own tolerance.

# --- costs in searches ------------------------------------------------------------------------------------------------
COMPRESS_ABOVE = 2.0  # A larger relative cost counts by its logarithm: into lost runs it grows by 1e7 within one step.
LOST_COST = 1e3  # A design where nothing works has this relative cost.
UNIT_OF_Z = 0.03  # The first step of a climb goes at most this far in weights and in the unit box, the unit of z.
PER_UNIT = UNIT_OF_Z**-2  # With this unit of the value a first step among bounds is no longer than the gradient.
STEEPEST = 1e3  # Longer relative gradients are shortened to this.
LOST_VALUE = 1e9 * PER_UNIT  # A climb has this value where the cost is not finite.
# L-BFGS stops at these relative tolerances.
CLIMB_OPTIONS = {"maxcor": 20, "ftol": 1e-7, "gtol": 1e-5 / UNIT_OF_Z}
GAINED = 1e-7  # A local search has gained if the cost falls by more than this part of it.
BETTER_SHARE = 0.25  # Only this quantile of them counts: designs that lose their runs say nothing.
CMA_SETTLED = 1e-3  # CMA-ES has converged at this spread in the unit box.
SATURATION = 1e-3  # A saturation is rounded off within this part of the range of the input from its bound.

# --- starts and the landscape -----------------------------------------------------------------------------------------
# No climb starts at a local optimum worse than the best by this part of its return without design cost.
WORTH_A_START = 0.2
COMPASS_LAST_STEP = 0.01  # A climb of the landscape ends at this step in the unit box.
RIDGE = 2e-3  # Local optima are one if they are parted by less than this part of the return without the design's cost.

# --- the expert and its sets ------------------------------------------------------------------------------------------
NEARLY_LINEAR = 0.1  # A linearisation is trusted in this part of its ellipsoid.
EDGE_OF_SET = 1e-3  # An input leads to the edge of a set within this part of the set's range along a row.
IMITATED = 2.0  # No state is imitated beyond so many half-widths of X: a run that is being lost teaches nothing.
LED_BACK = 0.1  # A state outside a set by at most this part of its range along a row is led back.
ACCEPTED_SHARE = 0.25  # If a smaller share of the candidates is accepted, the others are moved into their sets.

# --- episodes and previews --------------------------------------------------------------------------------------------
# A disturbance may be this multiple of the largest drawn: an active limit would make an MPC infeasible.
PREVIEW_ROOM = 3.0

# --- entries of the design without effect -----------------------------------------------------------------------------
MAGNITUDES = (-5.0, 1.0)  # States, inputs and disturbances have these powers of ten beside their extents.
TERM_ROUNDING = 1e-12  # A change below this part of the largest value or slope of a term is rounding.
ACT_TOGETHER = 1e-6  # Entries act together below this singular value of slopes with rows and columns of norm one.
IDLE_PART = 1e-3  # An entry with less than this in a unit direction that changes nothing has no part in it.

# --- a fit, a controller given, and the settling baseline -------------------------------------------------------------
EXCITATION = 0.3  # Inputs of the first fit have this standard deviation, in parts of half the input's range.
BLIND_SHARE = 0.5  # A policy without a gradient in a larger share of the runs is not led by it.
NO_GRADIENT = 1e-9  # A run whose gradient is smaller than this part of the return has none.
LEAST_ACTION = 1e-3  # A policy is taken to do at least this part of the range of an input.
# A search of the numbers that are tuned begins with these steps.
RETUNE_STEPS = {"gain": 0.5, "offset": 0.1, "law": 0.2}
FEW_RUNS_DECIDE = 2.0  # A few runs decide where their standard deviation exceeds this multiple of their mean.
UNFORESEEN = 0.5  # An objective that promises more by this part of what control costs did not see what happens.

# --- comparison of methods --------------------------------------------------------------------------------------------
NOT_WORSE_PERCENT = 100 * NOT_WORSE  # Methods are equal within this part of the reference's return [%].
MORE_LOST = 1e-3  # A method is not the best if it loses more of the runs than the one that loses fewest by this.
OWN_OBJECTIVE = 5.0  # A difference between a method's own objective and the closed loop is worth a word above this [%].
OUTSIDE_SHARE = 1e-3  # A share of states outside the limits is worth a word above twice the reference's and this.
DEEPEST_SHOWN = 0.25  # Returns below the best by more than this part of the reference's are shown at the lower edge.
