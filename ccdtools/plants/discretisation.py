"""Exact zero-order-hold discretisation, symbolic in the design."""

from __future__ import annotations

import math

import casadi as ca

from ccdtools.checks import as_choice, as_instance, as_positive
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel, check_finite
from ccdtools.plants.plant import Plant
from ccdtools.plants.sampling_guard import warn_of_aliasing
from ccdtools.plants.zero_order_hold import zero_order_hold


def discretise(plant: Plant, dt: float | None = None, *, sampling_guard: str = "warn") -> LinearModel:
    """The exact zero-order-hold model of a linear plant, symbolic in its design.

    Parameters
    ----------
    plant : Plant
        Linear in x, u and w; any smooth dependence on p. A discrete plant is taken as it is.
    dt : float, optional
        Sampling time [s]; the plant's own by default.
    sampling_guard : {"warn", "ignore"}
        Whether a `SamplingWarning` says that some design has an oscillation near or beyond half the sampling rate.

    Returns
    -------
    LinearModel

    Raises
    ------
    InputError
        If the dynamics are not linear in (x, u, w), have a constant term, are not finite over the whole box of
        designs, or a discrete plant is given another `dt`.

    References
    ----------
    Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978, eq. (1.1);
    Moler and Van Loan, "Nineteen dubious ways …, twenty-five years later", SIAM Review 45, 2003, method 3
    (scaling and squaring), after balancing.
    """
    as_instance("plant", plant, Plant, "a Plant")
    as_choice("sampling_guard", sampling_guard, ("warn", "ignore"))
    dt = as_positive("dt", plant.dt if dt is None else dt, unit="s")
    A, B, E = _linear_matrices(plant)
    if not plant.continuous:
        if not math.isclose(dt, plant.dt):
            raise InputError("dt", dt, f"{plant.dt} or nothing", f"The plant is discrete, sampled at {plant.dt} s.")
        return LinearModel(plant.p, A, B, E, dt, plant.design)
    if sampling_guard == "warn":
        warn_of_aliasing(plant, dt)
    A, B, E = zero_order_hold(A, B, E, dt, symbols=plant.p, design=plant.design)
    return LinearModel(plant.p, A, B, E, dt, plant.design)


def _linear_matrices(plant: Plant) -> tuple[ca.SX, ca.SX, ca.SX]:
    """∂f/∂x, ∂f/∂u and ∂f/∂w of linear dynamics f, finite over the box of designs."""
    z = ca.vertcat(plant.x, plant.u, plant.w)
    M = ca.jacobian(plant.dynamics, z)
    if ca.depends_on(M, z):
        rows = [plant.state_names[i] for i in range(plant.nx) if ca.depends_on(ca.jacobian(plant.dynamics[i], z), z)]
        raise InputError("plant", f"dynamics nonlinear in x, u or w for {', '.join(rows)}", "linear ones")
    check_finite(ca.Function("M", [plant.p], [ca.densify(M)]), plant.design, "the dynamics")
    rest = ca.Function("rest", [z, plant.p], [plant.dynamics])(ca.SX.zeros(z.shape), plant.p)
    if not ca.simplify(rest).is_zero():
        raise InputError("plant", "a constant term in the dynamics", "linear ones", "State it as a disturbance.")
    nx = plant.nx
    nu = plant.nu
    return M[:, :nx], M[:, nx : nx + nu], M[:, nx + nu :]
