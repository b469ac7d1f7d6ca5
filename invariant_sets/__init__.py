"""Convex polytopes and invariant sets of linear systems: numpy, scipy and daqp, nothing else."""

from .admissible_inputs import AdmissibleInputs
from .control_invariant import maximal_control_invariant_set
from .exceptions import InvariantSetsError
from .parametric import ParametricSet
from .polytope import Polytope
from .results import SetResult, Status

__all__ = [
           "AdmissibleInputs",
           "InvariantSetsError",
           "ParametricSet",
           "Polytope",
           "SetResult",
           "Status",
           "maximal_control_invariant_set",
]
