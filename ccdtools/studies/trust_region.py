"""Trust region of a redesign around what is deployed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.learned_result import LearnedCoDesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignStatus
from ccdtools.evidence.percent import share
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.sampled_model import SampledModel
from ccdtools.plants.tolerances import ON_BOUND
from ccdtools.studies.tolerances import CONSTANT_E, FIRST_RADIUS, LEAST_RADIUS, UNATTRIBUTED
from ccdtools.twin.transport import ErrorSplit, full_rank
from ccdtools.twin.twin import DigitalTwin


@dataclass(frozen=True)
class ErrorAttribution:
    """Parts of the logged errors unknown at another design."""

    rest: float  # part of the errors' energy that does not enter through E(p)
    # further part that the discrepancy explains by state and input: it may change with the design otherwise than E
    explained: float
    identified: bool  # whether every disturbance can be told from an error, at every design where E(p) changes at all

    @property
    def limits(self) -> bool:
        """Whether a redesign is limited to a trust region."""
        return not self.identified or self.rest + self.explained > UNATTRIBUTED

    def describe(self) -> str:
        """Reason why a redesign is limited, or not."""
        if not self.identified:
            return "E(p) is not of full column rank everywhere"
        shares = f"{share(self.rest)} of the errors' energy does not enter through E(p)"
        return f"{shares}, {share(self.explained)} depends on state and input"


@dataclass(frozen=True)
class Trust:
    """Radius of the trust region, after the deployments so far."""

    radius: float = FIRST_RADIUS  # largest move of a parameter, as a part of its range; from 1 on there is no limit
    # whether a deployment fell short of what was predicted: from then on the region counts whatever the doubt
    betrayed: bool = False

    def after(self, kept: bool | None) -> Trust:
        """Trust after a deployment that kept its prediction (None if undecided)."""
        if kept is None:
            return self
        if kept:
            return replace(self, radius=min(1.0, 2 * self.radius))
        return Trust(max(LEAST_RADIUS, self.radius / 2), betrayed=True)

    def limits(self, doubt: ErrorAttribution) -> bool:
        """Whether a redesign is limited."""
        return self.radius < 1 and (self.betrayed or doubt.limits)


def attribute_errors(twin: DigitalTwin, scale: Array) -> ErrorAttribution:
    """Parts of a twin's errors unknown at another design."""
    split = ErrorSplit(twin.model, scale)
    logs = twin.carried()
    left = [replace(log, p=logs[-1].p) for log in twin.innovations()]
    whole = sum(_energy(log.e_next, scale) for log in logs)
    if whole == 0:
        return ErrorAttribution(0.0, 0.0, True)
    rest = split.share_of_the_rest(logs)
    entering = sum(_energy(log.e_next - split.rest(log), scale) for log in left)
    unknown = min(1.0, max(0.0, 1 - entering / whole))
    return ErrorAttribution(rest, max(0.0, unknown - rest), _identified(twin, scale))


def within(problem: CoDesignProblem, centre: Array, radius: float) -> CoDesignProblem:
    """Problem with a box of designs narrowed to a radius about `centre`.

    A whole number may take the next one either way, however short its range or small the radius.
    """
    space = problem.design
    middle = space.to_unit(centre)
    lower = space.from_unit(np.clip(middle - radius, 0, 1))
    upper = space.from_unit(np.clip(middle + radius, 0, 1))
    whole = space.whole
    least, most = space.outermost
    lower[whole] = np.maximum(np.floor(np.minimum(lower + ON_BOUND, centre - 1))[whole], least[whole])
    upper[whole] = np.minimum(np.ceil(np.maximum(upper - ON_BOUND, centre + 1))[whole], most[whole])
    return replace(problem, model=problem.model.within(replace(space, lower=lower, upper=upper)))


def edges(design: Array, region: DesignSpace, space: DesignSpace) -> dict[str, str]:
    """Parameters at an edge of a region, with "lower" or "upper"."""
    bounds = space.active_bounds(design)
    return {name: side for name, side in region.active_bounds(design).items() if bounds.get(name) != side}


def in_whole_box(result: LearnedCoDesign, region: DesignSpace, space: DesignSpace) -> LearnedCoDesign:
    """Result of a region, as read in the whole box.

    A whole number is held by no slope: that the best one stands at an edge says as much.
    """
    at = edges(result.design, region, space)
    holding = {CoDesignStatus.AT_BOUND: set(space.names), CoDesignStatus.CONVERGED: set(space.integer)}
    held = holding.get(result.status, set()) & at.keys()
    status = CoDesignStatus.EDGE_OF_TRUST if held else result.status
    active = space.active_constraints(result.design)
    return replace(result, active_bounds=space.active_bounds(result.design), status=status, active_constraints=active)


def _identified(twin: DigitalTwin, scale: Array) -> bool:
    """Whether E is constant or of full column rank over the box."""
    space = twin.model.design
    if space is None:
        return True
    designs = space.spread()
    matrices = twin.model.matrices(designs)[2] / scale[:, None]
    if isinstance(twin.model, SampledModel) and twin.model.nw and not matrices.any():
        return False  # it enters away from rest only, where it may change with the design
    if np.ptp(matrices, axis=0).max(initial=0.0) <= CONSTANT_E * np.abs(matrices).max(initial=0.0):
        return True
    return all(full_rank(twin.model, p, scale) for p in designs)


def _energy(errors: Array, scale: Array) -> float:
    """Sum of squares of errors (..., nx) in scaled states."""
    return float(np.square(errors / scale).sum())
