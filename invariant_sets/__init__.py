"""Convex polytopes and invariant sets of linear systems: numpy, scipy and daqp, nothing else."""

from invariant_sets.admissible_inputs import AdmissibleInputFamily, AdmissibleInputs
from invariant_sets.control_invariant import maximal_control_invariant_set
from invariant_sets.exceptions import InputError, InvariantSetsError
from invariant_sets.minimal_robust import minimal_robust_positively_invariant_set
from invariant_sets.parametric import ParametricSet
from invariant_sets.plotting import plot_family, plot_polytope
from invariant_sets.polytope import Polytope
from invariant_sets.positive_invariant import maximal_positively_invariant_set
from invariant_sets.reachability import controllable_set, predecessor_set, reachable_set
from invariant_sets.results import Certificate, SetResult, Status

__all__ = [
    "AdmissibleInputFamily",
    "AdmissibleInputs",
    "Certificate",
    "InputError",
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
