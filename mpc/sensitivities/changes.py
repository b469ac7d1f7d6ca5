"""How cost and limits of an MPC problem change with parameters, as a user says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.problem import MPCProblem
from mpc.sensitivities.derivatives import as_derivatives
from mpc.sensitivities.regulator import lqr_sensitivity


@dataclass(frozen=True, eq=False)
class Changes:
    """How cost and limits change with parameters.

    Attributes
    ----------
    Q, R, S, P : (·, ·, np) arrays
    bounds : dict of str to (rows, np) array
        Of h in {v : Hv <= h}, by kind of constraint.
    model : dict of str to (·, ·, np) array
        dA, dB and dE of a linear model.
    """

    Q: Array
    R: Array
    S: Array
    P: Array
    bounds: dict[str, Array]
    model: dict[str, Array]

    @property
    def parameters(self) -> int:
        """np."""
        return int(self.Q.shape[-1])


def as_changes(problem: MPCProblem, given: Mapping[str, ArrayLike | None], count: int | None = None) -> Changes:
    """Derivatives dA, dB, dE, dQ, dR, dS, dP, dX, dU, d_terminal_set and d_rate_limit, checked; 0 for what is None.

    Where the terminal weight is the solution of the Riccati equation, its derivative follows from the others.

    Parameters
    ----------
    problem : MPCProblem
    given : dict of str to array
    count : int, optional
        Number of parameters; by default what the arrays say.
    """
    nx, nu, nw = problem.nx, problem.nu, problem.nw
    if given.get("dE") is not None and not nw:
        raise InputError("dE", "a derivative", "none", "The controller has no disturbance matrix E.")
    if given.get("dP") is not None and problem.given_P is None:
        cure = "It is the Riccati solution here, whose derivative follows from the others."
        raise InputError("dP", "a derivative", "none, because no P was given", cure)
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
    return Changes(found["dQ"], found["dR"], found["dS"], found["dP"], bounds, model)
