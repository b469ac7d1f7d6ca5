"""Tolerances of `invariant_sets`, relative [-] unless they count.

"Of the extent" means: in coordinates in which the bounding box of the set at hand has half widths of one.
"""

import sys

# --- what a set is ---------------------------------------------------------------------------------------------------
# What is thinner than this part of the extent is flat, what is closer is one, what misses by more is not. Accepted
# optima of linear programs with rows of unit norm have no larger residual.
FLAT = 1e-9
# Data and what doubles make of them may be wrong by this part of the sum of their absolute terms: a sum below is zero.
ROUNDING = 1e-12
PLACE = 4e-15  # A given number, a point or a product of matrices may be wrong by this part of its absolute terms.
DEPENDENT = 1e-11  # A row or direction of which less than this part of its terms is left depends on the others.
MEMBERSHIP = 1e-9  # A point in a set may by default violate a row by this part of its range over the bounding box.
REDUNDANT = 1e-11  # A row that cuts off less than this part of the extent is redundant, and ends a recursion.
# Sets are computed to this part of the extent: the default of `tol`, the largest relative gap between an invariant set
# and its outer set; where vertices lie; the optima that no solver improves; what is left of terms; how much closer a
# step looks.
COARSE = 1e-7

# --- coordinates -----------------------------------------------------------------------------------------------------
MUCH = 1e3  # What is so many times larger or smaller is looked at in other coordinates, and a bound so far is loose.
SMALL = 0.1  # A set that began with width two is rescaled below this width; a box is enlarged by this part of it.

# --- linear programs -------------------------------------------------------------------------------------------------
LP_SOLVER = 1e-10  # The solvers are handed this feasibility tolerance, and their multipliers meet it.

# --- the recursion ---------------------------------------------------------------------------------------------------
# These parts in turn are taken off an outer set that has not converged; the last three are tried as contractions per
# step, too.
SHRUNK = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
EIGENVALUE = 1e-6  # Eigenvalues closer to one another or to the unit circle than this part of their modulus are one.

# --- filters ---------------------------------------------------------------------------------------------------------
FAR_PROPOSAL = 1e6  # A proposal that is more half widths of U away is moved to here along its direction.
LARGEST_ROOM = sys.float_info.max**0.5  # Rooms and inputs are clipped here [-], so that products of them are finite.
