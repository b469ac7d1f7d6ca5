"""Every tolerance of `invariant_sets`, with its meaning. All of them are relative, so none depends on units.

"Of the extent" means: in coordinates in which the bounding box of the set at hand has half widths of one.
"""

# --- what a set is ---------------------------------------------------------------------------------------------
FLAT = 1e-9  # of the extent: a set thinner than this is flat, one that misses feasibility by more is empty
SAME = 1e-9  # of the extent: vertices and rows closer than this are one
ROUNDING = 1e-12  # of |bᵢ| + |Aᵢ||x|: what the data of a row may be wrong by after a computation in doubles
CANCELLED = 1e-13  # of the sum of absolute terms: a sum smaller than this is zero, its terms have cancelled
DEPENDENT = 1e-11  # of the sum of absolute terms: an equality row smaller than this depends on the others
MEMBERSHIP = 1e-9  # of the row's range over the bounding box: default tolerance of `contains` and `is_subset`

# --- linear programs -------------------------------------------------------------------------------------------
LP_RESIDUAL = 1e-9  # rows of unit norm: largest primal, dual and complementarity residual of an accepted answer
LP_COARSE = 1e-7  # the same, where no solver does better: rows that are almost parallel leave no more digits
LP_ROUNDING = 1e-12  # of |bᵢ| + |Aᵢ||x|: added to it where the data are large
LP_SOLVER = 1e-10  # feasibility tolerance handed to the solvers
ACTIVE = 1e-7  # of the largest multiplier: rows with more are taken for active when an answer is recomputed
UNEVEN = 1e-3  # of the largest entry of its row: columns with smaller entries only are scaled before solving
RAY = 1e-13  # of |Fᵢ||d|: a direction d may rise by this along a row and still counts as a ray
STEEP_RAY = 1e-7  # of the largest entry of d: a ray has to move at least this far in the coordinate asked for

# --- the window around a set ---------------------------------------------------------------------------------------
THIN = 1e-7  # of the window: a set that misses feasibility by less may still be there; look closer
CLOSER = 1e-8  # of the window: factor of the largest step closer
SETTLED = 1e-4  # of the window: extents larger than this are known to 1e-6 of themselves
CLOSED = 1e-10  # of the sum of absolute terms: multipliers whose rows sum to less are a Farkas certificate

# --- minimal descriptions ----------------------------------------------------------------------------------------
REDUNDANT = 1e-11  # of the extent: a row that cuts less off than this is redundant
CHECKED = 1e-7  # of the extent: vertices and linear programs must agree to this in five and more dimensions
EPS = 4e-16  # of a unit row: entries of this size are rounding
TOUCHING = 1e-7  # of the extent: a vertex this close to a row lies on the face that is drawn
