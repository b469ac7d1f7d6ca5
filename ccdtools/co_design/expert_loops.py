"""Closed loops of the expert, with filters that keep them in X_fea(p)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import VALUE_TAIL, VISITS
from ccdtools.co_design.candidates import Starts
from ccdtools.co_design.design_controllers import linear_mpc
from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import LED_BACK
from ccdtools.exceptions import CCDError, InputError
from ccdtools.plants.models import Model
from ccdtools.progress import counted
from ccdtools_ground.door import as_floats, shown
from ccdtools_ground.user_functions import at_step, stopped
from invariant_sets import AdmissibleInputs, Polytope

Law = Callable[[Array], Array]
DesignLaw = Callable[[CoDesignProblem, Array], Law]  # a law of each design, as the `laws` of a study


def follow(
    problem: CoDesignProblem, starts: Starts, law: Law, gamma: float, rng: np.random.Generator, *,
    progress: bool = False,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Closed loops on the problem's model and disturbances, recorded at `VISITS`.

    States (v, n, nx), inputs (v, n, nu) and discounted returns (v, n) of v visits; NaN where a run has diverged.
    """
    x = starts.x
    steps = VISITS[-1] + VALUE_TAIL
    w = problem.driving(len(x), steps, rng)
    step = _stepped(problem, starts)
    rewards = np.empty((steps, len(x)))
    visited = []
    actions = []
    for k in counted(range(steps), "expert's closed loops", total=steps, progress=progress):
        u = law(x)
        if k in VISITS:
            visited.append(x)
            actions.append(u)
        before = x
        try:
            x, penalty = step(x, u, w[:, k])
        except InputError as error:
            raise at_step(k, error) from error
        x = np.where((np.abs(x) <= problem.limit).all(axis=1, keepdims=True), x, np.nan)
        earned = problem.objective.rewards(x, u, before, starts.p) - penalty
        rewards[k] = np.where(np.isnan(x).any(axis=1), np.nan, earned)
    future = rewards[-VALUE_TAIL // 4 :].mean(axis=0) / (1 - gamma)  # stationary by then
    values = []
    for k in reversed(range(steps)):
        future = rewards[k] + gamma * future
        if k in VISITS:
            values.append(future)
    return np.array(visited), np.array(actions), np.array(values[::-1])


def _stepped(problem: CoDesignProblem, starts: Starts) -> Callable[[Array, Array, Array], tuple[Array, Any]]:
    """Step to next states (n, nx) and penalties (n,).

    It is NaN where the state is: a lost run takes its step from the origin, so that no draw is looked up at NaN.
    """
    if problem.discrepancy is None:
        return lambda x, u, w: (starts.regions.step(x, u, slice(None), w), 0.0)
    stepper = Stepper.at(problem, torch.tensor(starts.p, dtype=torch.float32))
    e = torch.zeros(len(starts.p), problem.model.nx)

    @torch.no_grad()
    def updated(x: Array, u: Array, w: Array) -> tuple[Array, Array]:
        """Next states and penalties under errors or draws (n, nx)."""
        nonlocal e
        running = np.isfinite(x).all(axis=1, keepdims=True)
        state, applied = (torch.tensor(np.where(running, a, 0.0), dtype=torch.float32) for a in (x, u))
        penalty = stepper.penalties(e, state, applied)
        x_next, e = stepper.advance(state, e, applied, torch.tensor(w, dtype=torch.float32))
        return np.where(running, x_next.double().numpy(), np.nan), penalty.double().numpy()

    return updated


def expert_law(
    problem: CoDesignProblem, starts: Starts, expert: str | DesignLaw, horizon: int, *, progress: bool = False
) -> Law:  # fmt: skip
    """Inputs (n, nu) of the expert at each start's design; NaN where the state is.

    Parameters
    ----------
    problem : CoDesignProblem
    starts : Starts
    expert : {"lqr", "mpc", "explicit"} or function of (problem, design)
    horizon : int
        Of the MPC experts.
    progress : bool
    """
    if expert == "lqr":
        kept = set_filter(problem, starts)
        return lambda x: kept(x, starts.regions.inputs(x, np.arange(len(x))))
    experts: dict[Any, DesignLaw] = {
        "mpc": lambda problem, p: linear_mpc(problem, p, horizon=horizon),
        "explicit": lambda problem, p: linear_mpc(problem, p, horizon=horizon).explicit(),
    }
    make = experts[expert] if isinstance(expert, str) else expert
    label = f"{expert if isinstance(expert, str) else 'law'} of every design"
    designs: Any = counted(starts.p, label, total=len(starts.p), progress=progress)
    controllers = [make(problem, p) for p in designs]

    def planned(x: Array) -> Array:
        """Inputs (n, nu) of every run's controller."""
        u = np.full((len(x), problem.model.nu), np.nan)
        for i in np.flatnonzero(np.isfinite(x).all(axis=1)):
            u[i] = _asked(controllers[i], x[i], problem.model.nu)
        return u

    return planned


def _asked(controller: Law, x: Array, nu: int) -> Array:
    """Input (nu,) of a controller at a state (nx,)."""
    try:
        given = controller(x)
    except CCDError:
        raise
    except (TypeError, ValueError, IndexError) as error:
        at = f" for a state of shape {x.shape}"
        raise stopped("expert", controller, error, f"one that returns ({nu},)", at=at) from error
    u = as_floats("expert", given)
    if u.size != nu or not np.isfinite(u).all():
        raise InputError("expert", f"a controller that returns {shown(given)}", f"({nu},) finite numbers")
    return u.reshape(nu)


def stated_error(problem: CoDesignProblem) -> Callable[[Array], tuple[Array, Array]] | None:
    """Function p → error x⁺ − Ax − Bu of a stated mean, as bounds."""
    mean = problem.mean_disturbance
    return partial(_mean_error, problem.model, mean) if mean.any() else None


def _mean_error(model: Model, mean: Array, design: Array) -> tuple[Array, Array]:
    """E(p) times the mean, as bounds; picklable."""
    error = model.matrices(design)[2] @ mean
    return error, error


def set_filter(problem: CoDesignProblem, starts: Starts) -> Callable[[Array, Array], Array]:
    """Function of states and inputs (n, ·) → inputs that stay in X_fea.

    They are the given inputs, or where the next nominal state would leave the known set of its run, the nearest that
    keep it there.
    """
    model = starts.regions
    known = {i: S for i, S in enumerate(starts.sets) if S is not None and not S.is_empty}
    runs = np.array(list(known), dtype=int)
    sets: list[Polytope] = list(known.values())
    filters: dict[int, AdmissibleInputs] = {}  # runs of one design share one
    rows = max((len(S.b) for S in sets), default=0)
    F = np.zeros((len(runs), rows, problem.model.nx))  # rows scaled to X, those beyond a set's own always kept
    limits = np.ones((len(runs), rows))
    for k, S in enumerate(sets):
        size = np.abs(S.A) @ problem.state_scale
        F[k, : len(S.b)] = S.A / size[:, None]
        limits[k, : len(S.b)] = S.b / size
    of_states = F @ model.A[runs]
    of_inputs = F @ model.B[runs]
    stated = stated_error(problem)
    limits -= np.einsum("kij,kj->ki", F, model.E[runs] @ problem.mean_disturbance)

    def filtered(x: Array, u: Array) -> Array:
        """Inputs (n, nu) at states (n, nx)."""
        u = u.copy()
        after = of_states @ x[runs, :, None] + of_inputs @ u[runs, :, None]
        leaving = (after[..., 0] > limits).any(axis=1)  # NaN is not
        shared: dict[int, list[int]] = {}
        for k in np.flatnonzero(leaving & np.isfinite(x[runs]).all(axis=1)):
            shared.setdefault(id(sets[k]), []).append(int(k))
        for name, members in shared.items():
            S = sets[members[0]]
            chosen = runs[members]
            chosen = chosen[S.contains(x[chosen], LED_BACK)]
            if not len(chosen):
                continue
            if name not in filters:
                first = chosen[0]
                U = problem.input_limits(model.designs[first])
                W = stated and stated(model.designs[first])
                filters[name] = AdmissibleInputs(model.A[first], model.B[first], S, U, W=W)
            u[chosen] = filters[name].project(x[chosen], u[chosen])[0]
        return u

    return filtered
