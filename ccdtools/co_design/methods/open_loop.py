"""Optimal control problem over trajectories and the design, with its limits."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import MEAN, Mean, MeanSpread, WorstCase
from ccdtools.co_design.tolerances import SATURATION
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools.output_limits import OutputLimits, limits_of
from ccdtools.plants.simulated_model import SimulatedModel
from ccdtools_ground.user_functions import at_step
from mpc import NotStabilisableError
from mpc.optimal_control import OptimalControlProblem, Phase, Solution, build, solve

ROW = re.compile(r"path (\d+)")
PLACE = re.compile(r"( of phase \d+)|( at t = [^,]+)|(, by .*)")
MORE = re.compile(r"and \d+ more ")
GIVEN = ("dynamics", "start of")
CURE = "Nested or learned co-design simulates the problem as it is."


def open_loop_problem(
    problem: CoDesignProblem, scenarios: tuple[Array, Array], *, design: Array, gain: Array | None = None,
    constrained: bool = True,
) -> OptimalControlProblem:  # fmt: skip
    """Best trajectories of given scenarios, with a design they share.

    Each scenario has inputs of its own, chosen with its whole disturbance known: what no controller can do, and what
    bounds them all. With `gain`, they share a feedback, too, see `fed_back`, whose K is found from that one on.

    Parameters
    ----------
    problem : CoDesignProblem
    scenarios : arrays (n, nx) and (n, T, nw)
    design : (np,) array
        To start from, with saturated LQR; its whole numbers are held.
    gain : (nu, nx) array, optional
    constrained : bool
        Whether the constraints on the design are part of it.

    Raises
    ------
    InputError
        If the problem asks for what trajectories cannot honour: a simulator, a learned error, a cost without symbols,
        a warm-up, or a risk other than the mean, with or without its spread, and the worst case.
    """
    check_open_loop(problem)
    x0, w = scenarios
    sizes = problem.model.nx, problem.model.nu, problem.design.dim
    guess = followed(problem, scenarios, design)
    shape = None if gain is None else gain.shape
    phases = [_phase(problem, x0[i], w[i], guess[i], shape) for i in range(len(x0))]
    space = problem.design
    lower, upper = space.lower.copy(), space.upper.copy()
    lower[space.whole] = upper[space.whole] = design[space.whole]
    first, names = design, list(space.names)
    if gain is not None:
        lower, upper = np.r_[lower, np.full(gain.size, -np.inf)], np.r_[upper, np.full(gain.size, np.inf)]
        first = np.r_[design, gain.ravel(order="F")]
        names += [f"gain {i + 1}" for i in range(gain.size)]
    given: dict[str, Any] = {"risk": "worst" if isinstance(problem.risk, WorstCase) else "sum"}
    if isinstance(problem.risk, MeanSpread):
        given |= {"risk": "spread", "spread": problem.risk.weight}
    cost = problem.objective.design_cost
    if cost is not None:
        function, share = cost.function(sizes[2]), problem.steps / (problem.objective.episode or problem.steps)
        given["p_cost"] = lambda p: function(p[: sizes[2]]) * share
    if constrained and space.constraints is not None:
        limits = space.constraints
        given["p_constraints"] = lambda p: limits(p[: sizes[2]])
        given["p_constraint_names"] = space.constraint_names
    return OptimalControlProblem(
        phases, p_bounds=(lower, upper), p_guess=first, p_names=names, linked=False,
        **given,
    )  # fmt: skip


def at_the_mean(
    problem: CoDesignProblem, stated: Callable[[CoDesignProblem], OptimalControlProblem], **given: Any
) -> Solution | None:
    """Optimum for the mean of costs, to start a spread's program; None if it counts none.

    From elsewhere a solver begins far from the limits, where costs are best all alike: at the kink of no spread.
    """
    if not isinstance(problem.risk, MeanSpread):
        return None
    found = solve(build(stated(replace(problem, risk=MEAN))), **given)
    return found if found.solved else None


def fed_back(problem: CoDesignProblem, shape: tuple[int, ...], x: Any, p: Any) -> Any:
    """Inputs (nu) of the saturated feedback u = −K x.

    K stands in the parameters after the design. The saturation is rounded off, by at most half of `SATURATION` times
    the range of an input, so that it is smooth.
    """
    size = problem.design.dim
    asked = -ca.reshape(p[size:], *shape) @ x
    U = problem.U
    if isinstance(U, DesignLimits):
        lower, upper = ca.vertsplit(U.both.function(size)(p[:size]), U.dim)
    else:
        lower, upper = (ca.DM(bound) for bound in problem.input_bounds)
    soft = SATURATION * (upper - lower)
    return (lower + upper + ca.sqrt((asked - lower) ** 2 + soft**2) - ca.sqrt((asked - upper) ** 2 + soft**2)) / 2


def check_open_loop(problem: CoDesignProblem) -> None:
    """Raise an `InputError` if trajectories cannot honour the problem."""
    objective = problem.objective
    symbolic = isinstance(objective, CustomObjective) or (
        isinstance(objective, QuadraticObjective) and type(objective).rewards is QuadraticObjective.rewards
    )
    refused = {
        "a simulator, which has no expressions": isinstance(problem.model, SimulatedModel),
        "a problem with a learned error of its model": problem.discrepancy is not None,
        f"a {type(objective).__name__} whose rewards are no CasADi expression": not symbolic,
        "a problem with a warm-up": problem.warm_up > 0,
        f"the risk {problem.risk!r}": not isinstance(problem.risk, Mean | MeanSpread | WorstCase),
    }
    for got, is_so in refused.items():
        if is_so:
            raise InputError("method", f"optimal trajectories of {got}", "a problem that they can honour", CURE)


def _phase(problem: CoDesignProblem, x0: Array, w: Array, guess: Any, gain: Any) -> Phase:
    """Phase of one scenario, by a gain of that shape if given."""
    nx, nu, size = problem.model.nx, problem.model.nu, problem.design.dim
    step = problem.model.step
    stage, terminal = costs(problem)
    limits = path_limits(problem, fed_back=gain is not None)
    lower, upper = problem.input_bounds
    if gain is not None:
        guess = (guess[0], guess[1], np.zeros((len(guess[0]), 0)))
    signal = np.vstack([w, w[-1:]]) if w.shape[1] else None

    def applied(x: Any, u: Any, p: Any) -> Any:
        """Inputs at a state."""
        return u if gain is None else fed_back(problem, gain, x, p)

    def path(x: Any, u: Any, p: Any) -> Any:
        """Limits, each ≤ 0."""
        return ca.vertcat(*(limit.scaled.function(nx, nu, size)(x, applied(x, u, p), p[:size]) for limit in limits))

    return Phase(
        dynamics=lambda x, u, w, p: step(x, applied(x, u, p), w, p[:size]), states=nx,
        inputs=0 if gain is not None else nu, stage_cost=lambda x, u, p: stage(x, applied(x, u, p), p[:size]),
        terminal_cost=lambda x, p: terminal(x, p[:size]) - first_cost(problem, x0), start=x0, duration=len(w),
        discrete=True, u_bounds=(None, None) if gain is not None else (lower, upper),
        path=path if limits else None, signal=signal, guess=guess, state_names=problem.state_names,
        input_names=() if gain is not None else problem.input_names,
    )  # fmt: skip


def costs(problem: CoDesignProblem) -> tuple[Any, Any]:
    """Cost functions (x, u, p) of a present step, and (x, p) of the end."""
    objective = problem.objective
    nx, nu, size = problem.model.nx, problem.model.nu, problem.design.dim
    if isinstance(objective, CustomObjective):
        end = objective.terminal_cost
        return objective.stage_cost.function(nx, nu, size), (
            (lambda x, p: 0.0) if end is None else end.function(nx, size)
        )
    assert isinstance(objective, QuadraticObjective)
    Q, R = ca.DM(objective.Q), ca.DM(objective.R)
    S = None if objective.S is None else ca.DM(objective.S)

    def stage(x: Any, u: Any, p: Any) -> Any:
        """Cost by the present state; the next states' sum differs by first and last."""
        own = ca.bilin(Q, x, x) + ca.bilin(R, u, u)
        return own if S is None else own + 2 * ca.bilin(S, x, u)

    return stage, lambda x, p: ca.bilin(Q, x, x)


def first_cost(problem: CoDesignProblem, x0: Array) -> float:
    """Stage cost of a first state, left out by next-state objectives."""
    objective = problem.objective
    return float(x0 @ objective.Q @ x0) if isinstance(objective, QuadraticObjective) else 0.0


def drawn(problem: CoDesignProblem, runs: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Scenarios (n, nx) and (n, T, nw); one of every worst case."""
    if isinstance(problem.risk, WorstCase):
        runs = problem.risk.cases or runs
    x0, w = scenario_tensors(problem, runs, rng)
    return x0.double().numpy(), w.double().numpy()


def lqr_or_none(problem: CoDesignProblem, design: Array) -> LinearFeedback:
    """Saturated LQR of a design, or no feedback where there is none."""
    try:
        return saturated_lqr(problem, design)
    except NotStabilisableError:
        return LinearFeedback(np.zeros((problem.model.nu, problem.model.nx)))


def followed(problem: CoDesignProblem, scenarios: tuple[Array, Array], design: Array) -> list[Any]:
    """Trajectories (times, x, u) of saturated LQR, held where they diverge."""
    x0, w = scenarios
    law = lqr_or_none(problem, design)
    step = problem.model.stepper(design, batch=len(x0))
    states, inputs = [x0], []
    for k in range(w.shape[1]):
        u = law(states[-1])
        try:
            after = np.nan_to_num(step(states[-1], u, w[:, k]))
        except InputError as error:
            raise at_step(k, error) from error
        after = np.clip(after, -2 * problem.state_scale, 2 * problem.state_scale)
        states.append(after)
        inputs.append(u)
    x, u = np.stack(states, axis=1), np.stack([*inputs, inputs[-1]], axis=1)
    return [(np.linspace(0.0, 1.0, x.shape[1]), x[i], u[i]) for i in range(len(x0))]


def path_limits(problem: CoDesignProblem, *, fed_back: bool) -> tuple[OutputLimits, ...]:
    """Limits on states, inputs and outputs other than input bounds.

    Limits on inputs are left out if `fed_back`.
    """
    found = []
    if isinstance(problem.U, DesignLimits) and not fed_back:
        found.append(limits_of(problem.U, problem.input_names))
    if problem.limit_tolerance == "off":
        return tuple(found)
    found.append(problem.state_rows)
    if problem.output_limits is not None:
        found.append(problem.output_limits)
    return tuple(found)


def told(problem: CoDesignProblem, solution: Any, *, fed_back: bool = False) -> tuple[str, ...]:
    """Notes on a trajectory solution that is not optimal."""
    if solution.solved:
        return ()
    broken = in_words(problem, solution.conflicts, fed_back=fed_back)
    of_limits = (f"not kept together: {', '.join(broken)}",) if broken else ()
    return (*of_limits, *([] if solution.status.name == "INFEASIBLE" else [solution.status.advice]))


def in_words(problem: CoDesignProblem, conflicts: tuple[str, ...], *, fed_back: bool) -> tuple[str, ...]:
    """Contradictions in the problem's names, each limit once.

    Dynamics and starts are named where nothing else is: they are given.
    """
    sizes = (problem.model.nx, problem.model.nu, problem.design.dim)
    texts = [
        limit.row_text(row).replace(" > ", " ≤ ").replace(" < ", " ≥ ")
        for limit in path_limits(problem, fed_back=fed_back)
        for row in range(limit.scaled.function(*sizes).numel_out(0))
    ]
    words = [
        ROW.sub(lambda found: texts[int(found[1]) - 1], PLACE.sub("", text))
        for text in conflicts if not MORE.match(text)
    ]  # fmt: skip
    chosen = [word for word in words if not word.startswith(GIVEN)] or words
    return tuple(dict.fromkeys(chosen))
