"""Every tolerance of `invariant_sets`, with its meaning. All of them are relative, so none depends on units.

"Of the extent" means: in coordinates in which the bounding box of the set at hand has half widths of one.
"""

# --- what a set is ---------------------------------------------------------------------------------------------------
FLAT = 1e-9  # of the extent: a set thinner than this is flat, one that misses feasibility by more is empty
SAME = 1e-9  # of the extent: vertices and rows closer than this are one
ROUNDING = 1e-12  # of |bᵢ| + |Aᵢ||x|: what the data of a row may be wrong by after a computation in doubles
PLACE = 4e-15  # of the sum of absolute terms that a point was solved from: what its coordinates may be wrong by
GIVEN = 1e-15  # of its own size: what a coordinate of a point that the caller states may be wrong by
CANCELLED = 1e-13  # of the sum of absolute terms: a sum smaller than this is zero, its terms have cancelled
DEPENDENT = 1e-11  # of the sum of absolute terms: an equality row smaller than this depends on the others
MEMBERSHIP = 1e-9  # of the row's range over the bounding box: default tolerance of `contains` and `is_subset`

# --- linear programs -------------------------------------------------------------------------------------------------
LP_RESIDUAL = 1e-9  # rows of unit norm: largest primal, dual and complementarity residual of an accepted answer
LP_COARSE = 1e-7  # the same, where no solver does better: rows that are almost parallel leave no more digits
LP_ROUNDING = 1e-12  # of |bᵢ| + |Aᵢ||x|: added to it where the data are large
LP_SOLVER = 1e-10  # feasibility tolerance handed to the solvers
LP_PROXIMAL = 1e-9  # of a unit row: DAQP solves a linear program by proximal steps, until one moves by less
ACTIVE = 1e-7  # of the largest multiplier: rows with more are taken for active when an answer is recomputed
UNEVEN = 1e-3  # of the largest entry of its row: columns with smaller entries only are scaled before solving
RAY = 1e-13  # of |Fᵢ||d|: a direction d may rise by this along a row and still counts as a ray
STEEP_RAY = 1e-7  # of the largest entry of d: a ray has to move at least this far in the coordinate asked for

# --- the window around a set -----------------------------------------------------------------------------------------
THIN = 1e-7  # of the window: a set that misses feasibility by less may still be there; look closer
CLOSER = 1e-8  # of the window: factor of the largest step closer
SETTLED = 1e-4  # of the window: extents larger than this are known to 1e-6 of themselves
LOST = 1e-3  # of its slope: a row of which less is left on the affine hull of a flat set is as wrong as its rounding
CLOSED = 1e-10  # of the sum of absolute terms: multipliers whose rows sum to less are a Farkas certificate

# --- minimal descriptions --------------------------------------------------------------------------------------------
REDUNDANT = 1e-11  # of the extent: a row that cuts less off than this is redundant
CHECKED = 1e-7  # of the extent: vertices and linear programs must agree to this in five and more dimensions
EPS = 4e-16  # of a unit row: entries of this size are rounding
TOUCHING = 1e-7  # of the extent: a vertex this close to a row lies on its face
NULL_SPACE = 1e-8  # of the largest singular value, in coordinates of order one: directions below are in the null space

# --- projections and redundant rows ----------------------------------------------------------------------------------
ZERO_COEFFICIENT = 1e-12  # of a unit row: a smaller coefficient of the variable to be eliminated is rounding
ZERO_ROW = 1e-13  # norm of a combination of two unit rows that is nothing but rounding
NEEDLESS = 1e-12  # of the extent: a row that cuts less off than this is left out between two eliminations
NEEDLE_RADIUS = 1e-7  # of the extent: radius below which rows are not judged from an inner point
BEYOND = 1e-9  # of the box of a set: a row further away than this cannot touch it

# --- the problem in local coordinates --------------------------------------------------------------------------------
NEGLIGIBLE = 1e-8  # of the largest term: a coefficient or residual of an equality smaller than this is rounding
SILENT_ROW = 1e-12  # norm, beside rows of norm one, of a row that says nothing about a variable
DEPENDENT_COLUMNS = 1e-12  # of the largest singular value: smaller ones are zero in a least-squares solution
AT_REST = 1e-13  # of the extent: the origin is an equilibrium if it moves by less
NEEDLE = 0.03  # smallest width as a part of the largest, below which the coordinates are made round
THINNEST = 1e-12  # smallest width as a part of the largest that the round coordinates allow for
UNSEEN = 1e-11  # of |A|, balanced: directions that move the outputs by less are not seen by the constraints

# --- the recursion ---------------------------------------------------------------------------------------------------
GAP = 1e-7  # relative: default of `tol`, the largest gap between an invariant set and its outer set
LOOSE = 1e3  # of the extent of X: a step may move a coordinate by this before the bounds of the others are loose
STOP = 1e-11  # of the right-hand side: the outer recursion has converged if no row cuts more
CUT = 1e-12  # of the extent: a row that cuts less off is rounding
LEAST_RIGHT = 1e-3  # of the extent: least right-hand side that a cut is compared with
UNRESOLVED = 1e-6  # of the extent: radius below which a set that Qhull cannot resolve counts as flat
SMALL = 0.1  # width below which a set that began with width two is rescaled
CENTRAL = 1e-9  # of the extent: rows this close to the equilibrium pass through it
CLOSED_LOOP_MARGIN = 1e-9  # relative contraction per step asked of a closed loop, against rounding
SHRUNK = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)  # parts taken off an outer set that has not converged, in turn
CONTRACTIONS = (1e-3, 1e-2, 0.1)  # per step, tried in turn where the outer set has not converged
GAP_ROUNDING = 1e-6  # of `tol`: by how much a gap may exceed it
UNSTABLE = 1e-6  # an eigenvalue counts as unstable if its modulus exceeds one by more
REAL_EIGENVALUE = 1e-12  # of the modulus: an eigenvalue with a smaller imaginary part is real
DOUBLE_EIGENVALUE = 1e-6  # of the modulus: eigenvalues closer than this are treated as one Jordan block
SERIES_END = 1e-17  # norm of Λ⁻ʲ at which a series over the unstable modes is cut off and its tail bounded
EDGE = 1e-9  # of the longest: shorter edges of the sum over the unstable modes give no facet
DRIVEN = 1e-9  # of the largest: directions in which a disturbance moves the state less are not moved at all
SUM_END = 1e-13  # of the sum: terms smaller than this end a sum of supports
LEAST_ALPHA = 1e-12  # a partial sum is scaled up by at least this, against rounding
USEFUL_INPUTS = 1e-6  # of its width: by how much the box of the useful inputs is enlarged
NEIGHBOUR_MARGIN = 1e-9  # least inflation of a neighbour's set, as a part of its room
FELT = 1e-7  # of the room of a row: closer to it than this, a set is taken to touch it

# --- certificates ----------------------------------------------------------------------------------------------------
INVARIANT = 1e-9  # of the extent: a successor may leave by this, and the set still counts as invariant
MISSING = 1e-8  # of the extent: enlargement by a backward step that rounding may cause
DOUBTFUL = 1e-12  # of the extent: a violation above this is asked for a second time
WITNESS = 1e-6  # of U: an input proposed by a solver may leave U by this, and is then moved back into it
WITNESS_SOLVER = 1e-11  # primal tolerance of the solver that proposes the inputs
DUAL_RESIDUAL = 1e-11  # of a unit cost: multipliers that miss stationarity by less bound the optimum
FLAT_WIDTH = 1e-9  # of the largest width: width given to a coordinate in which a set is flat

# --- filters ---------------------------------------------------------------------------------------------------------
ADMISSIBLE = 1e-9  # of the extent of S: a successor may leave by this, and the input counts as admissible
INPUT_SLACK = 1e-8  # of the half widths of U: by how much a solver's answer may leave U
UNMOVED = 1e-14  # of the extent of S a half width of U: an input that moves a row by less does not move it

TINY = 1e-300  # a divisor that stands for zero without dividing by it

# --- samples ---------------------------------------------------------------------------------------------------
JITTER = 1e-18  # of a variance of order one: keeps the covariance of a sample positive definite
