from invariant_sets.admissible_inputs import (
    AdmissibleInputFamily as AdmissibleInputFamily,
    AdmissibleInputs as AdmissibleInputs,
)
from invariant_sets.exceptions import InputError as InputError, InvariantSetsError as InvariantSetsError
from invariant_sets.maximal_sets import (
    maximal_control_invariant_set as maximal_control_invariant_set,
    maximal_positively_invariant_set as maximal_positively_invariant_set,
)
from invariant_sets.minimal_robust import (
    minimal_robust_positively_invariant_set as minimal_robust_positively_invariant_set,
)
from invariant_sets.parametric import ParametricSet as ParametricSet
from invariant_sets.plotting import plot_family as plot_family, plot_polytope as plot_polytope
from invariant_sets.polytope import Polytope as Polytope
from invariant_sets.reachability import (
    controllable_set as controllable_set,
    predecessor_set as predecessor_set,
    reachable_set as reachable_set,
)
from invariant_sets.results import Certificate as Certificate, SetResult as SetResult, Status as Status
