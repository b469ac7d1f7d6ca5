"""Whether an agent was made for a problem."""

from __future__ import annotations

import numpy as np

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.tolerances import DESIGN_RANGE, SAME_BOUNDS
from ccdtools_ground.door import as_instance
from learning.networks import ActorCritic


def check_agent(problem: CoDesignProblem, agent: ActorCritic) -> None:
    """Raise an `InputError` unless `agent` fits states, designs and inputs."""
    as_instance("agent", agent, ActorCritic, "an ActorCritic", "fit_actor_critic makes one.")
    nx = problem.model.nx - problem.hidden
    space = problem.design
    observed = len(agent.observation_offset)
    if observed != nx + space.dim:
        raise InputError("agent", f"{observed} inputs", f"{nx} states and {space.dim} design parameters")
    offset = agent.observation_offset[nx:].double().numpy()
    scale = agent.observation_scale[nx:].double().numpy()
    if (np.abs(np.stack([space.lower, space.upper]) - offset) > DESIGN_RANGE * scale).any():
        raise InputError(
            "agent", f"one made for designs in {(offset - scale).tolist()} to {(offset + scale).tolist()}",
            "the whole box of designs", "Pass input_bounds=problem.observation_bounds to fit_actor_critic.",
        )  # fmt: skip
    _check_actions(problem, agent)


def _check_actions(problem: CoDesignProblem, agent: ActorCritic) -> None:
    """Raise an `InputError` unless an agent acts within U or U(p)."""
    if isinstance(problem.U, DesignLimits) or agent.action_limits is not None:
        if not _same_limits(problem, agent):
            raise InputError(
                "agent", "one that acts within other limits than U(p)", "the limits of the problem at every design",
                "Pass action_bounds=problem.action_bounds to fit_actor_critic.",
            )  # fmt: skip
        return
    middle = agent.action_offset.double().numpy()
    half = agent.action_scale.double().numpy()
    lower, upper = problem.input_bounds
    if (
        len(middle) != len(lower)
        or (np.abs(np.stack([middle - half - lower, middle + half - upper])) > SAME_BOUNDS * (upper - lower)).any()
    ):
        raise InputError(
            "agent", f"actions in {(middle - half).tolist()} to {(middle + half).tolist()}",
            f"{lower.tolist()} to {upper.tolist()}, the bounds U",
            "Pass action_bounds=problem.input_bounds to fit_actor_critic.",
        )  # fmt: skip


def _same_limits(problem: CoDesignProblem, agent: ActorCritic) -> bool:
    """True if both limits depend on the design and agree everywhere."""
    own, other = problem.U, agent.action_limits
    if not isinstance(own, DesignLimits) or other is None:
        return False
    if (other.entries, len(other.box[0])) != (own.entries, own.dim):
        return False
    designs = problem.design.spread()
    lower, upper = own.bounds(designs)
    distance = np.abs(np.stack([lower, upper]) - np.stack(other.bounds(designs)))
    return bool((distance <= SAME_BOUNDS * (upper - lower)).all())
