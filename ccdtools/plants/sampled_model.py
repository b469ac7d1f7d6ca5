"""Discrete model of a nonlinear plant, differentiable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.exceptions import InputError
from ccdtools.plants.budgets import PART_BY_COLLOCATION
from ccdtools.plants.collocation import ImplicitStep
from ccdtools.plants.compiled_step import explicit_kind
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.integration_error import IntegrationError
from ccdtools.plants.linear_model import DiscreteModel
from ccdtools.plants.plant import Plant
from ccdtools.plants.runge_kutta import ExplicitStep
from ccdtools_ground.door import as_array, as_choice, as_count, as_instance, as_positive, as_vector

METHODS = ("rk4", "collocation")


@dataclass(frozen=True, eq=False, repr=False)
class SampledModel(Immutable, DiscreteModel):
    """Model x⁺ = f(x, u, w, p) of a nonlinear plant.

    Made by `discretise`.

    Parameters
    ----------
    plant : Plant
    dt : float
        Sampling time [s].
    method : {"rk4", "collocation"}
        Runge–Kutta, or Radau IIA collocation for stiff plants. A discrete plant is taken as it is.
    substeps : int
        Equal parts of a sample.
    error : IntegrationError, optional
        What a step may be wrong by; None where it was not measured.
    scale : (nx,) array, optional
        Extent of each state, for the tolerances of CasADi's solver of collocation equations.
    errors : bool
        Whether the disturbance is (w, r), of which r (nx,) is added to the next state.
    compiled : bool
        Whether explicit steps of many runs are compiled by Numba: some seconds once, then many times as fast.
    jump : str
        Where the right-hand side of the plant jumps, which derivatives leave out; empty where no jump was found.
    """

    plant: Plant
    dt: float
    method: str = "rk4"
    substeps: int = 10
    error: IntegrationError | None = None
    scale: Array | None = field(default=None, repr=False)
    errors: bool = False
    compiled: bool = False
    jump: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        as_instance("plant", self.plant, Plant, "a Plant")
        self._set(dt=as_positive("dt", self.dt, unit="s"))
        as_choice("method", self.method, METHODS)
        self._set(substeps=as_count("substeps", self.substeps))

    def __repr__(self) -> str:
        parts = f"{self.method}, {self.substeps} parts a sample" if self.plant.continuous else "a discrete plant"
        known = "not measured" if self.error is None else f"at most {self.error.relative:.1g} of X a sample"
        error = f", error {known}" if self.plant.continuous else ""
        sizes = f"{self.nx} states, {self.nu} inputs, {self.nw} disturbances, dt = {self.dt:g} s"
        return f"SampledModel({sizes}, {parts}{error}, design: {self.design!r})"

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.plant.nx

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.plant.nu

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.plant.nw + self.nx * self.errors

    @property
    def design(self) -> DesignSpace:
        """Box of designs."""
        return self.plant.design

    @property
    def state_names(self) -> Sequence[str]:
        """Names of the plant's states."""
        return self.plant.state_names

    @property
    def input_names(self) -> Sequence[str]:
        """Names of the plant's inputs."""
        return self.plant.input_names

    @property
    def parts(self) -> int:
        """Runge–Kutta parts that take as long as a sample."""
        return (
            self.substeps * (PART_BY_COLLOCATION if self.method == "collocation" else 1) if self.plant.continuous else 1
        )

    @cached_property
    def advance(self) -> Callable[..., Any]:
        """(x, u, w, p) → x⁺ on arrays or tensors (..., n); leading shapes broadcast.

        Of tensors it is differentiable in all four; to second order where the dynamics are.
        """
        return self._with_errors(self._own_step)

    @cached_property
    def pathwise(self) -> Callable[..., Any]:
        """Step on torch tensors (n, ·) with p (np,) or (n, np), faster than `advance`.

        It is differentiable once.

        Where the step is implicit, `advance`.
        """
        from ccdtools.plants.pathwise_step import pathwise

        own = self._own_step
        return self._with_errors(partial(pathwise, own)) if isinstance(own, ExplicitStep) else self.advance

    def _with_errors(self, own: Callable[..., Any]) -> Callable[..., Any]:
        """(x, u, (w, r), p) → x⁺ + r of a step without errors, if the model has them."""

        def step(x: Any, u: Any, w: Any, p: Any) -> Any:
            """x⁺ (..., nx) of arrays or tensors."""
            if w.shape[-1] != self.nw:
                raise InputError("w", f"shape {tuple(w.shape)}", f"(..., {self.nw})")
            return own(x, u, w[..., : self.plant.nw], p) + w[..., self.plant.nw :]

        return step if self.errors else own

    @cached_property
    def _own_step(self) -> ExplicitStep | ImplicitStep:
        """The step without errors."""
        f = self.plant.right_hand_side
        kind = explicit_kind(f, self.compiled)
        if not self.plant.continuous:
            return kind(f, 1)
        if self.method == "rk4":
            return kind.of(f, self.dt, self.substeps)
        return ImplicitStep(f, self.dt, self.substeps, self.scale)

    def within(self, design: DesignSpace) -> SampledModel:
        """This model over another box of designs.

        Where that reaches beyond its own, the error is not known.
        """
        own = self.plant.design
        inside = design.dim == own.dim and bool(((design.lower >= own.lower) & (design.upper <= own.upper)).all())
        return replace(self, plant=replace(self.plant, design=design), error=self.error if inside else None)

    def with_errors(self) -> SampledModel:
        """Model driven by (w, r), with r (nx,) added to the next state."""
        return replace(self, errors=True)

    @cached_property
    def function(self) -> ca.Function:
        """p → [A B E] about x = 0, u = 0, w = 0, (nx, nx + nu + nw)."""
        p = ca.MX.sym("p", self.design.dim)
        at_rest = self._jacobian(*(ca.DM.zeros(size, 1) for size in (self.nx, self.nu, self.nw)), p)
        return ca.Function("matrices", [p], [at_rest])

    @cached_property
    def step(self) -> ca.Function:
        """(x, u, w, p) → x⁺ as a CasADi function."""
        own = self._own_step.function
        if not self.errors:
            return own
        x, u, w, p = (ca.MX.sym(n, size) for n, size in zip("xuwp", (self.nx, self.nu, self.nw, self.design.dim)))
        after = own(x, u, w[: self.plant.nw], p) + w[self.plant.nw :]
        return ca.Function("step", [x, u, w, p], [after], list("xuwp"), ["x_next"])

    def stepper(self, p: ArrayLike, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at design `p` (np,)."""
        p = self.design.check_one(p)
        own = self._own_step
        if isinstance(own, ExplicitStep) and not self.errors:
            return own.at(p)
        return lambda x, u, w: self.advance(x, u, w, p)

    @cached_property
    def _jacobian(self) -> ca.Function:
        """(x, u, w, p) → ∂x⁺/∂(x, u, w), (nx, nx + nu + nw)."""
        given = [ca.MX.sym(name, n) for name, n in zip("xuwp", (self.nx, self.nu, self.nw, self.design.dim))]
        after = self.step(*given)
        return ca.Function("jacobian", given, [ca.densify(ca.jacobian(after, ca.vertcat(*given[:3])))])

    def jacobians(
        self, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None, p: ArrayLike = ()
    ) -> tuple[Array, Array, Array]:
        """∂x⁺/∂x (nx, nx), ∂x⁺/∂u (nx, nu), ∂x⁺/∂w (nx, nw) at a point.

        Raises
        ------
        InputError
            If a size is wrong, the design lies outside its bounds, or a derivative is not finite.
        """
        x = as_vector("x", x, self.nx)
        u = as_vector("u", u, self.nu)
        w = np.zeros(self.nw) if w is None else as_vector("w", w, self.nw)
        J = np.asarray(self._jacobian(x, u, w, self.design.check_one(p)), dtype=float)
        if not np.isfinite(J).all():
            place = f"x = {x.tolist()}, u = {u.tolist()}"
            raise InputError("x", f"{place}, where a derivative is not finite", "a point at which the plant is smooth")
        A, B, E = np.split(as_array("jacobian", J, (self.nx, "n")), [self.nx, self.nx + self.nu], axis=1)
        return np.ascontiguousarray(A), np.ascontiguousarray(B), np.ascontiguousarray(E)
