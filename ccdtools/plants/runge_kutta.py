"""The classical Runge–Kutta method over one held sample: explicit, fourth order."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca

from ccdtools.plants.casadi_arrays import Vectorised, check_sizes
from ccdtools.plants.native import Native, are_few_rows


class ExplicitStep:
    """(x, u, w, p) → x⁺ by repeating one expression: a Runge–Kutta substep, or the map of a discrete plant.

    Parameters
    ----------
    substep : casadi.Function
        (x, u, w, p) → x after a part of the sample.
    substeps : int
        Parts of a sample.
    """

    def __init__(self, substep: ca.Function, substeps: int) -> None:
        self.substep = substep
        self.substeps = substeps

    @classmethod
    def of(cls, f: ca.Function, dt: float, substeps: int) -> ExplicitStep:
        """Runge–Kutta steps of dx/dt = f(x, u, w, p) over `dt` seconds."""
        return cls(runge_kutta(f, dt / substeps), substeps)

    @cached_property
    def function(self) -> ca.Function:
        """The whole step as a CasADi expression."""
        x, u, w, p = (ca.SX.sym(name, *self.substep.size_in(i)) for i, name in enumerate("xuwp"))
        after = x
        for _ in range(self.substeps):
            after = self.substep(after, u, w, p)
        return ca.Function("step", [x, u, w, p], [ca.densify(after)], list("xuwp"), ["x_next"])

    @cached_property
    def _vectorised(self) -> Vectorised:
        """One substep on batches."""
        return Vectorised(self.substep)

    @cached_property
    def native(self) -> Native:
        """The whole step on few rows of arrays."""
        return Native(self.function)

    def __call__(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """x⁺ (..., nx) of arrays or tensors (..., n), whose leading shapes broadcast."""
        check_sizes(self.substep, (x, u, w, p))
        if are_few_rows(x, u, w, p):
            return self.native(x, u, w, p)
        for _ in range(self.substeps):
            x = self._vectorised(x, u, w, p)
        return x


def runge_kutta(f: ca.Function, h: float) -> ca.Function:
    """(x, u, w, p) → x after one step of `h` seconds of dx/dt = f(x, u, w, p), with u and w held.

    References
    ----------
    Hairer, Nørsett and Wanner, "Solving ordinary differential equations I", 2nd ed., 1993, table II.1.2.
    """
    x, u, w, p = (ca.SX.sym(name, *f.size_in(i)) for i, name in enumerate("xuwp"))
    k1 = f(x, u, w, p)
    k2 = f(x + h / 2 * k1, u, w, p)
    k3 = f(x + h / 2 * k2, u, w, p)
    k4 = f(x + h * k3, u, w, p)
    after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("substep", [x, u, w, p], [ca.cse(ca.densify(after))], list("xuwp"), ["x_next"])
