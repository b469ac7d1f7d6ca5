"""Status of a co-design, with advice."""

from __future__ import annotations

from ccdtools_ground.outcome import Outcome


class CoDesignStatus(Outcome):
    """Status of a co-design."""

    CONVERGED = "converged", "Nothing to do: more effort gained nothing that matters, and the design is level."
    AT_BOUND = (  # of the box, or an active constraint
        "converged, with the design at a bound",
        "Widen the named bounds, or relax the named constraints, if the plant allows it: the return still rises across "
        "them.",
    )
    EDGE_OF_TRUST = (
        "converged, with the design at the edge of the trust region",
        "Deploy it, and let another generation follow: where the prediction holds, the next redesign may go further.",
    )
    STILL_IMPROVING = (
        "still improving", "Raise CoDesignConfig.iterations: the last of them still gained significantly."
    )  # fmt: skip
    BUDGET_SPENT = (
        "budget spent before the design settled",
        "Raise the budget (CoDesignConfig.iterations of learning, Simultaneous.iterations, evaluations or starts of "
        "other methods): the return still rises along the design, or it was not seen that it does not.",
    )
    GRADIENT_UNTRUSTED = (
        "gradient untrusted",
        "Check that model and objective are differentiable, or raise the number of runs: the gradient through the "
        'model is not that of the return. Where the plant jumps or the policy saturates, take "ppo" or "search".',
    )
    DIVERGING = "runs diverge", "Check x0 and U: with this design and policy some runs cannot be recovered."
    LIMITS_BROKEN = (
        "limits broken", "Raise the tolerance of the limits or the budget; where a note names U, clip the inputs to U."
    )  # fmt: skip
    WORSE_THAN_BASELINE = (
        "worse than a baseline",
        "Deploy the named baseline, or start again from it: it is better on the same scenarios and keeps the limits.",
    )
    NOT_STATIONARY = (
        "not at an optimum of the policy",
        "Start again from another policy or with more iterations: a plain search over its last layer is better.",
    )
    INFEASIBLE = (
        "no trajectory within the limits",
        'Widen X, take fewer runs, or set limit_tolerance="off": no inputs keep the named limits in all scenarios.',
    )

    @property
    def settled(self) -> bool:
        """Whether more effort is expected to gain nothing, see `Settling`."""
        return self in (CoDesignStatus.CONVERGED, CoDesignStatus.AT_BOUND, CoDesignStatus.EDGE_OF_TRUST)
