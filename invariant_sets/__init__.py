"""Convex polytopes and invariant sets of linear systems: numpy, scipy and daqp, nothing else."""

from .admissible_inputs import AdmissibleInputs
from .control_invariant import maximal_control_invariant_set
from .exceptions import InvariantSetsError
from .parametric import ParametricSet
from .plotting import plot_family, plot_polytope
from .polytope import Polytope
from .positive_invariant import maximal_positively_invariant_set, minimal_robust_positively_invariant_set
from .reachability import controllable_set, predecessor_set, reachable_set
from .results import Certificate, SetResult, Status

__all__ = [
    "AdmissibleInputs",
    "Certificate",
    "InvariantSetsError",
    "ParametricSet",
    "Polytope",
    "SetResult",
    "Status",
    "controllable_set",
    "maximal_control_invariant_set",
    "maximal_positively_invariant_set",
    "minimal_robust_positively_invariant_set",
    "plot_family",
    "plot_polytope",
    "predecessor_set",
    "reachable_set",
]
