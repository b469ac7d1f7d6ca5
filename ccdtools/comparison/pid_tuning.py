"""PID tuned by random search and Nelder–Mead, and other baselines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.comparison.tolerances import RECOVERED, UNSTABLE_COST
from ccdtools.controllers.controllers import PID, Controller, Passive
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import Simulable
from ccdtools.simulation import simulate
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools_ground.door import as_array, as_count, as_generator, as_instance

REFERENCE = "LQR"


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
    """PID with the best mean return at one design, replayed errors included.

    Every candidate output is screened with log-uniform gains of both signs; the best few are refined by
    Nelder–Mead, all on the same scenarios; of a model that is not linear, both on its linearisation, and the model
    itself decides between the best of them. Every other scenario has a constant offset in its disturbance, and gains
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

    Raises
    ------
    InputError
        If an argument is of the wrong kind, or the problem's discrepancy adds no replayed errors that could have an
        offset.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    for name, number in (("runs", runs), ("screened", screened), ("starts", starts), ("refinements", refinements)):
        as_count(name, number)
    trial = _Trial.from_problem(problem, problem.design.check_one(design), runs, rng)
    steep = not isinstance(problem.model, LinearModel)  # a step of it costs a hundred of its linearisation's
    own = trial
    if steep:
        trial = replace(trial, plant=_linearised(problem, trial.design))
    nu = problem.model.nu
    C_all = _default_outputs(trial.B) if outputs is None else as_array("outputs", outputs, ("k", nu, problem.model.nx))
    gains = rng.choice([-1.0, 1.0], (screened, 3, nu)) * 10 ** rng.uniform(-2, 1.5, (screened, 3, nu))
    gains[0] = 0.0
    gains[::3, 1] = 0.0
    screening = sorted(((trial.cost(C, g), C, g) for C in C_all for g in gains), key=lambda found: found[0])
    refined = []
    for value, C, z in screening[:starts]:
        result = minimize(
            lambda v, C=C: trial.cost(C, v), z.ravel(), method="Nelder-Mead",
            options={"maxfev": refinements, "xatol": 1e-3},
        )  # fmt: skip
        refined.append((result.fun, C, result.x) if result.fun <= value else (value, C, z))
    if steep:
        own = own.first(32)  # scenarios decide where the model is nonlinear
        best = sorted(refined + screening[:starts], key=lambda found: found[0])
        refined = [(own.cost(C, z), C, z) for _, C, z in best]
    _, C, z = min(refined, key=lambda found: found[0])
    found = trial.controller(C, z)
    return replace(found, remark=found.remark or own.remark(found))


@dataclass(frozen=True, eq=False)
class _Trial:
    """Model, design and scenarios, half with an offset, for all candidates."""

    problem: CoDesignProblem
    plant: Simulable
    design: Array
    A: Array
    B: Array
    x0: Array
    w: Array

    @classmethod
    def from_problem(cls, problem: CoDesignProblem, design: Array, runs: int, rng: np.random.Generator) -> _Trial:
        """Trial of so many scenarios."""
        plant = _tried(problem)
        A, B, _ = problem.model.matrices(design)
        x0, drawn = problem.scenarios.sample(runs, problem.steps, rng)
        w = np.array(drawn)
        changing = (w != w[:, :1]).any(axis=(0, 1))  # an uncertain mass stays what it is
        w[::2] += changing * w.std(axis=(0, 1)) * rng.standard_normal((len(w[::2]), 1, w.shape[2]))
        return cls(problem, plant, design, A, B, x0, w)

    def first(self, runs: int) -> _Trial:
        """This trial on its first scenarios alone."""
        return replace(self, x0=self.x0[:runs], w=self.w[:runs])

    def controller(self, C: Array, z: Array) -> PID:
        """PID of gains `z`, (3, nu) or flat, in full inputs, half-widths of X, samples."""
        lower, upper = self.problem.input_bounds_at(self.design)
        reach = np.abs(C) @ self.problem.state_scale
        unit = np.divide((upper - lower) / 2, reach, out=np.zeros_like(reach), where=reach > 0)
        kp, ki, kd = z.reshape(3, -1) * unit
        dt = self.problem.model.dt
        return PID(C, kp, ki / dt, kd * dt, dt=dt, lower=lower, upper=upper)

    def cost(self, C: Array, z: Array) -> float:
        """Mean cost of a candidate, `UNSTABLE_COST` if the loop is unstable."""
        pid = self.controller(C, z)
        return self.loss(pid) if is_stable(self.A, self.B, pid) else UNSTABLE_COST

    def loss(self, controller: Controller) -> float:
        """Mean cost of a controller."""
        problem = self.problem
        run = simulate(
            self.plant, controller, x0=self.x0, steps=problem.steps, disturbance=self.w, design=self.design,
            limit=problem.limit,
        )  # fmt: skip
        return float(-run.returns(problem.objective).mean())

    def remark(self, pid: PID) -> str:
        """Remark if, without offsets, little of LQR's gain over passive is recovered."""
        laws = (Passive(self.problem.model.nu), saturated_lqr(self.problem, self.design), pid)
        plain = replace(self, x0=self.x0[1::2], w=self.w[1::2])
        passive, lqr, own = (plain.loss(law) for law in laws)
        if passive <= lqr or passive - own >= RECOVERED * (passive - lqr):
            return ""
        return f"its gains recover {(passive - own) / (passive - lqr):.1%} of what LQR gains over the passive plant"


def _linearised(problem: CoDesignProblem, p: Array) -> LinearModel:
    """Model linearised at one design, driven by disturbances or state errors."""
    model = problem.model
    *dynamics, E = model.matrices(p)
    driven_by = E if problem.discrepancy is None else np.eye(model.nx)
    A, B, entering = (ca.SX(ca.DM(M)) for M in (*dynamics, driven_by))
    return LinearModel(ca.SX.sym("p", len(p)), A, B, entering, model.dt, model.design)


def _tried(problem: CoDesignProblem) -> Simulable:
    """Nominal model, or the updated one driven by replayed errors."""
    model: Simulable = problem.model
    if problem.discrepancy is None:
        return model
    if problem.discrepancy.noise != "replayed":
        got = f"noise {problem.discrepancy.noise!r}, which no offset can be added to"
        raise InputError("problem.discrepancy", got, "'replayed', or no discrepancy", "Pass updated_problem(…).")
    discrepancy = as_instance("problem.discrepancy", problem.discrepancy, Discrepancy, "a Discrepancy")
    return TwinPlant(problem.model, discrepancy)


def is_stable(A: Array, B: Array, pid: PID) -> bool:
    """Whether the unsaturated PID, with its memory, stabilises (A, B) asymptotically."""
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
    """Candidate outputs (k, nu, nx): each state for one input, and what inputs push."""
    pushed: Array = B.T / np.maximum(np.linalg.norm(B, axis=0), np.finfo(float).tiny)[:, None]
    if B.shape[1] > 1:
        return pushed[None]
    return np.concatenate([np.eye(len(B))[:, None, :], pushed[None]])


def baselines(problem: CoDesignProblem, design: ArrayLike, *, rng: np.random.Generator) -> dict[str, Controller]:
    """Passive, LQR, tuned PID and MPC (horizon 20) at one design, by name.

    LQR and MPC are those of the nominal model; the PID is tuned on the problem's own.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    design = problem.design.check_one(design)
    return {
        "passive": Passive(problem.model.nu),
        REFERENCE: saturated_lqr(problem, design),
        "PID": tuned_pid(problem, design, rng=rng),
        "MPC": linear_mpc(problem, design),
    }
