"""The co-design problem: a ramp and a rough road, one strut, one optimal control problem."""

from __future__ import annotations

import casadi as ca
import numpy as np

from active_suspension.roads import SPEED, Road
from ccdtools import Plant
from mpc.optimal_control import OptimalControlProblem, Phase

DURATION = 2.0  # s
GRADE = 0.25  # of the ramp
TYRE, COMFORT, EFFORT = 1e5, 0.5, 1e-5  # weights of tyre deflection [m], acceleration of the body [m/s²] and force [N]
WEIGHTS = (1.0, 0.01)  # of rough road and ramp
SHORTEST, GROWTH = 0.05, 1.25  # of the longest interval after the wheel meets the ramp, and of each to the one before
OF_ROUGH = ("linear range", "Soderberg", "Zimmerli", "oil pressure", "valve lift", "piston speed")
OF_RAMP = ("bump stop", "oil pressure", "valve lift", "piston speed")
PUBLISHED = {
    "nested": (0.0166, 0.1686, 0.0396, 6.5015, 0.0094, 0.0395, 0.1700),
    "simultaneous": (0.0200, 0.1820, 0.0335, 10.7308, 0.0097, 0.0405, 0.1700),
}
STARTS = {
    "theirs, 1": (0.01, 0.12, 0.05, 6, 0.0067, 0.04, 0.15),
    "theirs, 2": (0.01, 0.129, 0.106, 3.57, 0.006, 0.035, 0.17),
    "theirs, 3": (0.0125, 0.2250, 0.2600, 9.5000, 0.0075, 0.0550, 0.2000),
    "theirs, 7": (0.0199, 0.1567, 0.03835, 7.95, 0.006528, 0.05099, 0.16999),
}  # those of the code of Sundarrajan and Herber, by its numbers


def problem(plant: Plant, road: Road, start, *, rules: bool = True) -> OptimalControlProblem:
    """Rough road and ramp side by side, with the dimensions of the strut as what they share.

    Parameters
    ----------
    plant : Plant
        A `detailed_active_suspension`.
    road : function
        Times (n,) → vertical speed (n,) of the rough road.
    start : (7,) array
        The design to begin with.
    rules : bool
        Whether the rules of the dimensions are constraints of the problem; a search that keeps them itself needs none.
    """

    def kept(wanted: tuple[str, ...]) -> ca.Function:
        chosen = [i for i, name in enumerate(plant.output_names) if name.startswith(wanted)]
        return ca.Function("kept", [plant.x, plant.p], [plant.outputs[chosen]], ["x", "p"], ["rules"])

    acceleration = plant.dynamics[3]
    cost = TYRE * plant.x[0] ** 2 + COMFORT * acceleration**2 + EFFORT * plant.u**2
    stage_cost = ca.Function("cost", [plant.x, plant.u, plant.p], [cost], ["x", "u", "p"], ["cost"])

    def load_case(speed: Road, wanted: tuple[str, ...]) -> Phase:
        return Phase(
            dynamics=plant.right_hand_side, states=4, inputs=1, stage_cost=stage_cost, start=[0.0] * 4,
            duration=DURATION, path=kept(wanted), signal=lambda t: np.asarray(speed(t))[:, None],
            state_names=plant.state_names, input_names=plant.input_names,
        )  # fmt: skip

    def ramp(t: np.ndarray) -> np.ndarray:
        return np.full(len(t), GRADE * SPEED)

    space = plant.design
    return OptimalControlProblem(
        [load_case(road, OF_ROUGH), load_case(ramp, OF_RAMP)], p_bounds=(space.lower, space.upper), p_guess=start,
        p_constraints=(lambda p: space.constraints(p)) if rules else None, linked=False, weights=WEIGHTS,
    )  # fmt: skip


def meshes(rough: int = 200, longest: float = 0.02) -> list[np.ndarray]:
    """Equal intervals along the rough road; after the wheel meets the ramp growing ones, up to a `longest` [s]."""
    steps = [SHORTEST * longest]
    while sum(steps) < DURATION:
        steps.append(min(GROWTH * steps[-1], longest))
    graded = np.append(0.0, np.cumsum(steps) / sum(steps))
    graded[-1] = 1.0
    return [np.linspace(0, 1, rough + 1), graded]
