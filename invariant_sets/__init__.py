"""Convex polytopes and invariant sets of linear systems: numpy, scipy and daqp, nothing else."""

from .admissible_inputs import AdmissibleInputs
from .control_invariant import maximal_control_invariant_set
from .exceptions import InvariantSetsError
from .parametric import ParametricSet
from .polytope import Polytope
from .results import InvariantSet, Status

__all__ = ["AdmissibleInputs", "InvariantSet", "InvariantSetsError", "ParametricSet", "Polytope", "Status",
           "maximal_control_invariant_set"]
