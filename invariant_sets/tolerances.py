"""Tolerances of `invariant_sets`, relative [-] unless they count.

"Of the extent" means: in coordinates in which the bounding box of the set at hand has half widths of one.
"""

# --- what a set is ---------------------------------------------------------------------------------------------------
FLAT = 1e-9  # What is thinner than this part of the extent is flat, what is closer is one, what misses by more is not.
ROUNDING = 1e-12  # Data and what doubles make of them may be wrong by this part of the sum of their absolute terms.
PLACE = 4e-15  # A point or product of matrices may be wrong by this part of the sum of absolute terms behind it.
GIVEN = 1e-15  # A number that the caller states, and an entry beside a row of norm one, may be wrong by this part.
CANCELLED = 1e-13  # A sum smaller than this part of the sum of its absolute terms is zero; a series ends there.
DEPENDENT = 1e-11  # A row or direction of which less than this part of its terms is left depends on the others.
MEMBERSHIP = 1e-9  # A point in a set may by default violate a row by this part of its range over the bounding box.

# --- linear programs -------------------------------------------------------------------------------------------------
LP_RESIDUAL = 1e-9  # An accepted answer has no larger residual for rows of unit norm; proximal steps end at it, too.
LP_COARSE = 1e-7  # Where no solver does better this residual is accepted; smaller multipliers and values are zero.
LP_SOLVER = 1e-10  # The solvers are handed this feasibility tolerance, and their multipliers meet it.
BOXES = (1e3, 1e6, 1e9, 1e12, 1e15)  # These half widths [-] are tried in turn if a program without a ray is unsolved.
UNEVEN = 1e-3  # A column is scaled if none of its entries reaches this part of the largest entry of its row.

# --- the local box around a set ---------------------------------------------------------------------------------------
THIN = 1e-7  # A ball whose radius is within this part of the extent from zero decides nothing: look closer.
CLOSER = 1e-8  # One step closer shrinks the local box by this factor at most.
SETTLED = 1e-4  # Extents larger than this part of the local box are known to 1e-6 of themselves.
HALF_BOX = 4.0  # The local box has this half width, where the set should have half widths of one.
WIDER = 1e3  # One step away widens the local box by this factor, and a scale that is more wrong is replaced.
ENDLESS = 1e300  # A set that has not ended at this size [units of x] has no end that doubles can tell.
LOST = 1e-3  # A row that keeps less than this part of its slope on a flat hull is as wrong as its rounding.

# --- minimal descriptions --------------------------------------------------------------------------------------------
REDUNDANT = 1e-11  # A row that cuts off less than this part of the extent is redundant, and ends a recursion.
TOUCHING = 1e-7  # Vertices are known to this part of the extent: one closer to a row lies on its face.

# --- the problem in local coordinates --------------------------------------------------------------------------------
NEGLIGIBLE = 1e-8  # What is below this part of the largest term of an equality, or of a row of order one, is rounding.
NEEDLE = 0.03  # Coordinates are made round if the smallest width is below this part of the largest one.

# --- the recursion ---------------------------------------------------------------------------------------------------
WELL_INSIDE = 0.02  # The origin stays the equilibrium if it is further than this part of X from every row.
GAP = 1e-7  # `tol`, the largest relative gap between an invariant set and its outer set, has this default.
LOOSE = 1e3  # A step that moves a coordinate by more extents of X than this makes the other bounds loose.
BOX_ROOM = 0.1  # A box is enlarged by this part of its width; a row is far beyond its inverse times the width.
LEAST_RIGHT = 1e-3  # A cut is compared with a right-hand side of at least this part of the extent.
SMALL = 0.1  # A set that began with width two is rescaled below this width.
# These parts in turn are taken off an outer set that has not converged; the last three are tried as contractions per
# step, too.
SHRUNK = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
EIGENVALUE = 1e-6  # Eigenvalues closer to one another or to the unit circle than this part of their modulus are one.

# --- certificates ----------------------------------------------------------------------------------------------------
MISSING = 1e-8  # A backward step may by rounding enlarge a set by this part of the extent.
WITNESS = 1e-6  # An input that a solver proposes may leave U by this part, and is then moved back into it.

# --- filters ---------------------------------------------------------------------------------------------------------
FAR_PROPOSAL = 1e6  # A proposal that is more half widths of U away is moved to here along its direction.

# --- sizes that doubles, memory and time allow -----------------------------------------------------------------------
LARGEST_ROOM = 1e150  # Rooms and inputs are clipped at this size [-], so that a diverged state cannot raise an error.
