"""Status of a co-design, with advice."""

from __future__ import annotations

from enum import Enum


class CoDesignStatus(Enum):
    """Status of a co-design."""

    CONVERGED = "converged"
    AT_BOUND = "converged, with the design at a bound"  # of the box, or an active constraint
    EDGE_OF_TRUST = "converged, with the design at the edge of the trust region"
    STILL_IMPROVING = "still improving"
    BUDGET_SPENT = "budget spent before the design settled"
    GRADIENT_UNTRUSTED = "gradient untrusted"
    DIVERGING = "runs diverge"
    LIMITS_BROKEN = "limits broken"
    WORSE_THAN_BASELINE = "worse than a baseline"
    NOT_STATIONARY = "not at an optimum of the policy"
    INFEASIBLE = "no trajectory within the limits"

    @property
    def settled(self) -> bool:
        """Whether more effort is expected to gain nothing, see `Settling`."""
        return self in (CoDesignStatus.CONVERGED, CoDesignStatus.AT_BOUND, CoDesignStatus.EDGE_OF_TRUST)

    @property
    def advice(self) -> str:
        """Advice on the next step, in one sentence."""
        return _ADVICE[self]


_ADVICE = {
    CoDesignStatus.CONVERGED: "Nothing to do: more effort gained nothing that matters, and the design is level.",
    CoDesignStatus.AT_BOUND: (
        "Widen the named bounds, or relax the named constraints, if the plant allows it: the return still rises across "
        "them."
    ),
    CoDesignStatus.EDGE_OF_TRUST: (
        "Deploy it, and let another generation follow: where the prediction holds, the next redesign may go further."
    ),
    CoDesignStatus.STILL_IMPROVING: "Raise CoDesignConfig.iterations: the last of them still gained significantly.",
    CoDesignStatus.BUDGET_SPENT: (
        "Raise the budget (CoDesignConfig.iterations of learning, Simultaneous.iterations, evaluations or starts of "
        "other methods): the return still rises along the design, or it was not seen that it does not."
    ),
    CoDesignStatus.GRADIENT_UNTRUSTED: (
        "Check that model and objective are differentiable, or raise the number of runs: the gradient through the "
        'model is not that of the return. Where the plant jumps or the policy saturates, take "ppo" or "search".'
    ),
    CoDesignStatus.WORSE_THAN_BASELINE: (
        "Deploy the named baseline, or start again from it: it is better on the same scenarios and keeps the limits."
    ),
    CoDesignStatus.NOT_STATIONARY: (
        "Start again from another policy or with more iterations: a plain search over its last layer is better."
    ),
    CoDesignStatus.DIVERGING: "Check x0 and U: with this design and policy some runs cannot be recovered.",
    CoDesignStatus.INFEASIBLE: (
        'Widen X, take fewer runs, or set limit_tolerance="off": no inputs keep the named limits in all scenarios.'
    ),
    CoDesignStatus.LIMITS_BROKEN: (
        "Raise the tolerance of the limits or the budget: they are left further than the tolerance."
    ),
}
