"""Derivatives of cost, limits and linear models by parameters, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.feedback import along_horizon
from mpc.halfspaces import Limits
from mpc.problem import MPCProblem
from mpc.rollout import Given, disturbance, pushes
from mpc.sensitivities.regulator import as_derivatives, lqr_sensitivity
from mpc.tolerances import EPS

SOFTENED = ("state", "terminal")  # kinds of constraints that a slack may relax


@dataclass(frozen=True, eq=False)
class Changes:
    """Derivatives of cost and limits by np parameters.

    Q, R, S, P : (·, ·, np); bounds : by kind of constraint (rows, np), of h in {v : Hv <= h}; units : likewise, of the
    units in which violations of soft limits have a price; model : dA, dB and dE (·, ·, np) of a linear model; reference
    : (nx + nu, np) of the state and input about which the cost is counted.
    """

    Q: Array
    R: Array
    S: Array
    P: Array
    bounds: dict[str, Array]
    units: dict[str, Array]
    model: dict[str, Array]
    reference: Array

    @property
    def parameters(self) -> int:
        """Number np of parameters."""
        return int(self.Q.shape[-1])


def as_changes(
    problem: MPCProblem, given: Mapping[str, ArrayLike | None], count: int | None = None, *, settles: bool = False
) -> Changes:  # fmt: skip
    """Derivatives dA, …, d_rate_limit, checked; 0 for None.

    Where the terminal weight is the solution of the Riccati equation, its derivative follows from the others, as does
    that of the rest where it `settles` there without a reference. The number of parameters is `count`, by default what
    the arrays say.
    """
    nx, nu, nw = problem.nx, problem.nu, problem.nw
    if given.get("dE") is not None and not nw:
        raise InputError("dE", "a derivative", "none", "The controller has no disturbance matrix E.")
    if given.get("dP") is not None and problem.given_P is None:
        cure = "It is the Riccati solution here, whose derivative follows from the others."
        raise InputError("dP", "a derivative", "none, because no P was given", cure)
    for name, value in given.items():
        if problem.W is not None and value is not None:
            cure = "The limits of a problem with W change with its model and weights, which this does not follow."
            raise InputError(name, "a derivative", "none beside W", cure)
    shapes: dict[str, tuple[int, ...]] = {
        "dA": (nx, nx), "dB": (nx, nu), "dE": (nx, nw), "dQ": (nx, nx), "dR": (nu, nu), "dS": (nx, nu), "dP": (nx, nx),
        "dX": (len(problem.state_rows[1]),), "dU": (len(problem.input_rows[1]),),
        "d_terminal_set": (len(problem.terminal_rows[1]),), "d_rate_limit": (0 if problem.rate_limit is None else nu,),
    }  # fmt: skip
    found = as_derivatives(
        {name: (given.get(name), shape) for name, shape in shapes.items()}, symmetric=("dQ", "dR", "dP"), count=count
    )
    if problem.given_P is None:
        own = {name: found[name] for name in ("dA", "dB", "dQ", "dR", "dS")}
        found["dP"] = lqr_sensitivity(problem.A, problem.B, Q=problem.Q, R=problem.R, S=problem.S, **own).dP
    bounds = {"state": found["dX"], "input": found["dU"], "terminal": found["d_terminal_set"],
              "rate": np.tile(found["d_rate_limit"], (2, 1))}  # fmt: skip
    model = {name: found[name] for name in ("dA", "dB", "dE")}
    units = {} if problem.soft is None else _unit_changes(problem.limits, bounds, found["dB"])
    reference = _rest_changes(problem, found) if settles else np.zeros((nx + nu, found["dQ"].shape[-1]))
    return Changes(found["dQ"], found["dR"], found["dS"], found["dP"], bounds, units, model, reference)


def _rest_changes(problem: MPCProblem, changes: Mapping[str, Array]) -> Array:
    """Derivatives (nx + nu, np) of the rest.

    There z'Wz is least of all with Gz + Ew = 0.
    """
    nx, size = problem.nx, problem.nx + problem.nu
    z, G = np.concatenate(problem.rest), np.hstack([problem.A - np.eye(nx), problem.B])
    W, dS = problem.stage_weight, changes["dS"]
    multipliers = -np.linalg.lstsq(G.T, W @ z, rcond=None)[0]
    dG = np.concatenate([changes["dA"], changes["dB"]], axis=1)
    dW = np.block([[[changes["dQ"]], [dS]], [[dS.swapaxes(0, 1)], [changes["dR"]]]])
    slope = np.einsum("ijp,j->ip", dW, z) + np.einsum("ijp,i->jp", dG, multipliers)
    drift = np.einsum("ijp,j->ip", dG, z)
    if problem.mean is not None:
        drift = drift + np.einsum("iwp,w->ip", changes["dE"], problem.mean)
    conditions = np.block([[W, G.T], [G, np.zeros((nx, nx))]])
    return np.asarray(-np.linalg.solve(conditions, np.concatenate([slope, drift]))[:size])


def _unit_changes(limits: Limits, bounds: dict[str, Array], dB: Array) -> dict[str, Array]:
    """Derivatives (rows, np) of soft limits' units, by kind.

    A unit is the size of a bound, or a reach; reaches are products of at most two numbers that change, piece by piece,
    of which central differences are exact. The unit of a bound that is zero does not change with that bound.
    """
    own, units = limits.own(), limits.price_units()
    change = {kind: np.sign(limits.sets[kind][1])[:, None] * np.where(own[kind][:, None], bounds[kind], 0.0)
              for kind in SOFTENED}  # fmt: skip
    if all(own[kind].all() for kind in SOFTENED):
        return change
    for j in range(dB.shape[-1]):
        moves = {kind: np.where(own[kind], bounds[kind][:, j], 0.0) for kind in own}
        sizes = [(moves[kind], units[kind]) for kind in own]
        sizes.append((dB[:, :, j], np.asarray(np.abs(limits.B).max() or 1.0)))
        if limits.rate is not None:
            moves["rate"] = bounds["rate"][: len(limits.rate), j]
            sizes.append((moves["rate"], limits.rate))
        largest = max(float(np.abs(move / size).max(initial=0.0)) for move, size in sizes)
        if largest == 0:
            continue
        step = np.cbrt(EPS) / largest
        reaches = []
        for part in (step, -step):
            sets = {kind: (H, h + part * moves[kind]) for kind, (H, h) in limits.sets.items()}
            rate = None if limits.rate is None else limits.rate + part * moves["rate"]
            reaches.append(Limits(limits.B + part * dB[:, :, j], sets, rate, limits.horizon).reaches())
        up, down = reaches
        for kind in SOFTENED:
            change[kind][:, j] += np.where(own[kind], 0.0, (up[kind] - down[kind]) / (2 * step))
    return change


class PlanModel(NamedTuple):
    """Derivatives of x⁺ = f(x, u, p) along a plan of states (N, nx) and inputs (N, nu), p (np,).

    first : (states, inputs) → f (N, nx), ∂f/∂x, ∂f/∂u and ∂f/∂p (N, nx, ·); second : (states, inputs, costates λ) →
    Hessians of Σ λ_i f_i by (x, u), and mixed derivatives with p (N, nx + nu, ·).
    """

    first: Callable[[Array, Array], tuple[Array, Array, Array, Array]]
    second: Callable[[Array, Array, Array], tuple[Array, Array]]


def linear_model(problem: MPCProblem, given: Given, changes: dict[str, Array]) -> PlanModel:
    """Derivatives of x⁺ = Ax + Bu + Ew along a plan."""
    A, B = along_horizon(problem)
    push = pushes(problem, given)
    pushed = np.einsum("xwp,kw->kxp", changes["dE"], disturbance(problem, given))

    def first(states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """f, ∂f/∂x, ∂f/∂u and ∂f/∂p."""
        by_parameters = np.einsum("xyp,ky->kxp", changes["dA"], states) + pushed
        by_parameters += np.einsum("xup,ku->kxp", changes["dB"], inputs)
        return states @ problem.A.T + inputs @ problem.B.T + push, A, B, by_parameters

    def second(states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """Curvature, which is zero, and mixed derivatives by parameters."""
        size = states.shape[1] + inputs.shape[1]
        mixed = [np.einsum("kx,xyp->kyp", costates, changes[name]) for name in ("dA", "dB")]
        return np.zeros((len(inputs), size, size)), np.concatenate(mixed, axis=1)

    return PlanModel(first, second)
