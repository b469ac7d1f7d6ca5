"""A PID tuned by random search and Nelder–Mead."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.checks import as_array, as_count, as_generator, as_instance
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import PID
from ccdtools.simulation import simulate


def tuned_pid(
    problem: CoDesignProblem,
    design: ArrayLike,
    *,
    rng: np.random.Generator,
    outputs: Array | None = None,
    runs: int = 128,
    screened: int = 48,
    starts: int = 3,
    refinements: int = 160,
) -> PID:
    """The PID with the best mean return on the problem's nominal model at one design.

    Every candidate output is screened with log-uniform gains of both signs; the best few are refined by
    Nelder–Mead, all on the same scenarios. Every other scenario has a constant offset in its disturbance, and gains
    that do not stabilise the unsaturated loop are refused: short episodes of noise that averages out would not show
    an integral that winds up, or slowly runs away.

    Parameters
    ----------
    design : (np,) array_like
    rng : numpy.random.Generator
    outputs : (k, nu, nx) array, optional
        Candidate output matrices C; each single state, for one input, and the states that the inputs push.
    runs, screened, starts, refinements : int
        Scenarios, random gains per output, best of these to refine, and evaluations of each refinement.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    for name, number in (("runs", runs), ("screened", screened), ("starts", starts), ("refinements", refinements)):
        as_count(name, number)
    design = problem.design.check_one(design)
    model = problem.model
    nu = problem.model.nu
    lower, upper = problem.input_bounds
    A, B, _ = model.matrices(design)
    C_all = _default_outputs(B) if outputs is None else as_array("outputs", outputs, ("k", nu, model.nx))
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    w[::2] += w.std(axis=(0, 1)) * rng.standard_normal((len(w[::2]), 1, w.shape[2]))
    half = (upper - lower) / 2

    def controller(C: Array, z: Array) -> PID:
        """`z` (3, nu): gains relative to full input at the edge of X, with time in samples."""
        unit = half / np.maximum(np.abs(C) @ problem.state_scale, 1e-12)
        kp, ki, kd = z * unit
        return PID(C, kp, ki / model.dt, kd * model.dt, dt=model.dt, lower=lower, upper=upper)

    def cost(C: Array, z: Array) -> float:
        """Mean cost of a candidate; a large one where the loop is not stable."""
        if not is_stable(A, B, controller(C, z.reshape(3, nu))):
            return 1e12
        run = simulate(
            model, controller(C, z.reshape(3, nu)), x0=x0, steps=problem.steps, disturbance=w, design=design,
            limit=problem.limit,
        )  # fmt: skip
        return float(-run.returns(problem.objective).mean())

    gains = rng.choice([-1.0, 1.0], (screened, 3, nu)) * 10 ** rng.uniform(-2, 1.5, (screened, 3, nu))
    gains[0] = 0.0
    gains[::3, 1] = 0.0
    screening = sorted(((cost(C, g), C, g) for C in C_all for g in gains), key=lambda found: found[0])
    refined = []
    for value, C, z in screening[:starts]:
        result = minimize(
            lambda v, C=C: cost(C, v), z.ravel(), method="Nelder-Mead", options={"maxfev": refinements, "xatol": 1e-3}
        )
        refined.append((result.fun, C, result.x) if result.fun <= value else (value, C, z))
    _, C, z = min(refined, key=lambda found: found[0])
    return controller(C, z.reshape(3, nu))


def is_stable(A: Array, B: Array, pid: PID) -> bool:
    """Whether x⁺ = A x + B u with the unsaturated PID is asymptotically stable, integral and last output included."""
    ny, nx = pid.C.shape
    proportional, integral, last = (
        np.diag(g) for g in (pid.kp + pid.ki * pid.dt + pid.kd / pid.dt, pid.ki, -pid.kd / pid.dt)
    )
    u = -np.hstack([proportional @ pid.C, integral, last])
    memory = np.zeros((2 * ny, nx + 2 * ny))
    memory[:ny, :nx] = pid.dt * pid.C
    memory[:ny, nx : nx + ny] = np.eye(ny)
    memory[ny:, :nx] = pid.C
    loop = np.vstack([np.hstack([A, np.zeros((nx, 2 * ny))]) + B @ u, memory])
    used = np.r_[np.ones(nx, bool), pid.ki != 0, pid.kd != 0]
    return bool(np.abs(np.linalg.eigvals(loop[np.ix_(used, used)])).max() < 1 - 1e-6)


def _default_outputs(B: Array) -> Array:
    """Candidate outputs (k, nu, nx): each state alone, for one input, and the states that the inputs push."""
    pushed = B.T / np.linalg.norm(B, axis=0)[:, None]
    if B.shape[1] > 1:
        return pushed[None]
    return np.concatenate([np.eye(len(B))[:, None, :], pushed[None]])
