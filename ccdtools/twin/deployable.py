"""Policy together with the design that it controls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.filtered import Filtered
from ccdtools.controllers.learned import LearnedPolicy
from invariant_sets import AdmissibleInputs
from learning.networks import ActorCritic


@dataclass(frozen=True, eq=False)
class Deployable:
    """Policy with the design that it controls, and its name."""

    agent: ActorCritic
    design: Array
    name: str = "the policy"

    def controller(self, admissible: AdmissibleInputs | None = None) -> Controller:
        """Deployed policy, behind the filter if there is one."""
        policy = LearnedPolicy(self.agent, self.design)
        return policy if admissible is None else Filtered(policy, admissible)

    def same_as(self, other: Deployable) -> bool:
        """Whether another deployable has the same policy and design."""
        weights = zip(self.agent.state_dict().values(), other.agent.state_dict().values())
        return np.array_equal(self.design, other.design) and all(bool((a == b).all()) for a, b in weights)
