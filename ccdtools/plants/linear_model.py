"""Linear discrete model whose matrices are functions of the design."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import NO_DESIGN, DesignSpace, check_finite
from ccdtools.plants.matrix_exponential import zero_order_hold
from ccdtools.plants.symbols import Symbolic, as_expression, as_symbols, check_known
from ccdtools_ground.door import as_array, as_finite, as_floats, as_instance, as_names, as_positive, shown


class DiscreteModel:
    """Base of the discrete models: matrices as functions of the design."""

    nx: Any
    nu: Any
    design: Any
    nw: Any
    function: Any
    stepper: Any
    jump = ""  # where it jumps, in words
    input_bounds: Any = (-np.inf, np.inf)  # that it takes

    @cached_property
    def jacobian(self) -> ca.Function:
        """p → ∂vec[A B E]/∂p, (nx·(nx + nu + nw), np), vec by columns."""
        kind: Any = ca.SX if self.function.is_a("SXFunction") else ca.MX
        p = kind.sym("p", *self.function.size_in(0))
        return ca.Function("jacobian", [p], [ca.densify(ca.jacobian(ca.vec(self.function(p)), p))])

    def matrices(self, p: ArrayLike = ()) -> tuple[Array, Array, Array]:
        """A (nx, nx), B (nx, nu), E (nx, nw) about 0 at a design (np,); stacked for (n, np).

        Raises
        ------
        InputError
            If a design has the wrong shape, lies outside its bounds, or makes a matrix infinite.
        """
        p = self._box.check(p)
        stacked = np.asarray(self.function(np.atleast_2d(p).T), dtype=float)
        if not np.isfinite(stacked).all():
            where = f"a design at which the model is not finite: {p.tolist()}"
            cure = "Leave it out of the design bounds, or state a plant that x = 0 is no point of in deviations."
            raise InputError("design", where, "one where A, B and E are finite", cure)
        matrices = stacked.reshape(self.nx, -1, self.function.size2_out(0)).transpose(1, 0, 2)
        M = matrices if p.ndim == 2 else matrices[0]
        A, B, E = (np.ascontiguousarray(part) for part in np.split(M, [self.nx, self.nx + self.nu], axis=-1))
        return A, B, E

    def derivatives(self, p: ArrayLike = ()) -> tuple[Array, Array, Array]:
        """∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np), ∂E/∂p (nx, nw, np) at a design."""
        p = self._box.check_one(p)
        T = (
            np.asarray(self.jacobian(p), dtype=float)
            .reshape(self.nx + self.nu + self.nw, self.nx, len(p))
            .transpose(1, 0, 2)
        )
        A, B, E = np.split(T, [self.nx, self.nx + self.nu], axis=1)
        return A, B, E

    def undisturbed(self, p: ArrayLike) -> Callable[[Array, Array], Array]:
        """(x (..., nx), u (..., nu)) → x⁺ (..., nx) at design `p` where w is 0."""
        step = self.stepper(p, batch=1)
        return lambda x, u: np.asarray(step(x, u, np.zeros((*x.shape[:-1], self.nw))))

    @property
    def _box(self) -> DesignSpace:
        """Box of designs, empty for a model without a design."""
        return NO_DESIGN if self.design is None else self.design


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(Symbolic, DiscreteModel):
    """Exact model x⁺ = A(p) x + B(p) u + E(p) w + c(p).

    Made by `discretise` or `LinearModel.from_state_space`.

    Parameters
    ----------
    symbols : casadi.SX (np, 1)
        The design p.
    A, B, E : casadi.SX (nx, nx), (nx, nu) and (nx, nw)
        Expressions in p.
    dt : float
        Sampling time [s].
    design : DesignSpace or None
        The box of designs; None where the model has none.
    c : casadi.SX (nx, 1), optional
        Constant term, such as what gravity adds in a step; none by default.
    state_names, input_names : sequence of str, optional
        Those of the plant; x1, x2, … and u1, u2, … by default.

    Raises
    ------
    InputError
        If the shapes disagree, or a matrix is not finite somewhere in the box of designs.
    """

    symbol_fields: ClassVar[tuple[str, ...]] = ("symbols",)
    expression_fields: ClassVar[tuple[str, ...]] = ("A", "B", "E", "c")

    symbols: ca.SX
    A: ca.SX
    B: ca.SX
    E: ca.SX
    dt: float
    design: DesignSpace | None
    c: Any = None
    state_names: Sequence[str] = ()
    input_names: Sequence[str] = ()

    def __post_init__(self) -> None:
        self._set(symbols=as_symbols("symbols", self.symbols))
        self._set(c=ca.SX.zeros(ca.SX(self.A).shape[0], 1) if self.c is None else self.c)
        for name in ("A", "B", "E", "c"):
            M = as_expression(name, getattr(self, name))
            check_known(name, M, symbols=self.symbols)
            self._set(**{name: M})
        nx = self.A.shape[0]
        if self.A.shape != (nx, nx) or nx == 0:
            raise InputError("A", f"shape {self.A.shape}", "a square matrix (nx, nx)")
        for name, M in (("B", self.B), ("E", self.E)):
            if M.shape[0] != nx:
                raise InputError(name, f"shape {M.shape}", f"{nx} rows, one per state")
        if self.c.shape != (nx, 1):
            raise InputError("c", f"shape {self.c.shape}", f"({nx}, 1), one row per state")
        self._set(state_names=as_names("state_names", self.state_names, nx, "x"))
        self._set(input_names=as_names("input_names", self.input_names, self.nu, "u"))
        self._set(dt=as_positive("dt", self.dt, unit="s"))
        if self.design is not None:
            as_instance("design", self.design, DesignSpace, "a DesignSpace or None")
        check_finite(self.function, self.design, "the matrices")
        check_finite(self._constant, self.design, "the constant term")

    @classmethod
    def from_state_space(cls, system: Any, *, E: ArrayLike | None = None, dt: float | None = None) -> LinearModel:
        """Model of a `control.StateSpace`, without a design.

        Parameters
        ----------
        system : control.StateSpace
            Discrete, or continuous together with `dt`. Its inputs are u; its outputs are not used.
        E : (nx, nw) array_like, optional
            Disturbance matrix, in the same time domain as `system`.
        dt : float, optional
            Sampling time [s] for a continuous system.

        Raises
        ------
        InputError
            If `system` is no state space; a continuous system comes without a positive `dt`, or a discrete one with
            a different `dt`; or if `E` has the wrong number of rows.
        """
        A, B = state_space_matrices(system)
        own = sampling_time(system, dt)
        E = np.zeros((len(A), 0)) if E is None else as_floats("E", E)
        E = E.reshape(len(E), -1) if E.ndim == 1 else E
        if E.ndim != 2 or len(E) != len(A):
            raise InputError("E", f"shape {E.shape}", f"{len(A)} rows, one per state")
        as_finite("E", E)
        p = ca.SX(0, 1)
        constants = (ca.SX(ca.DM(A)), ca.SX(ca.DM(B)), ca.SX(ca.DM(E)) if E.size else ca.SX(len(A), 0))
        if system.dt:
            return cls(p, *constants, own, None)
        return cls(p, *zero_order_hold(*constants, own, symbols=p, design=None), own, None)

    def __repr__(self) -> str:
        constant = ", a constant term" if self.affine else ""
        sizes = f"{self.nx} states, {self.nu} inputs, {self.nw} disturbances{constant}, dt = {self.dt:g} s"
        return f"LinearModel({sizes}, design: {self.design!r})"

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.E.shape[1]

    @property
    def affine(self) -> bool:
        """Whether a constant term moves the equilibrium from 0."""
        return not bool(self.c.is_zero())

    @cached_property
    def _constant(self) -> ca.Function:
        """p → c, (nx, 1)."""
        return ca.Function("constant", [self.symbols], [ca.densify(self.c)])

    @cached_property
    def function(self) -> ca.Function:
        """p → [A B E], (nx, nx + nu + nw)."""
        return ca.Function("matrices", [self.symbols], [ca.densify(ca.horzcat(self.A, self.B, self.E))])

    @cached_property
    def step(self) -> ca.Function:
        """(x, u, w, p) → x⁺, in CasADi."""
        x, u, w = (ca.SX.sym(name, size) for name, size in zip("xuw", (self.nx, self.nu, self.nw)))
        after = self.A @ x + self.B @ u + self.E @ w + self.c
        return ca.Function("step", [x, u, w, self.symbols], [ca.densify(after)], ["x", "u", "w", "p"], ["x_next"])

    def constant(self, p: ArrayLike = ()) -> Array:
        """c (nx,) at a design (np,); stacked for designs (n, np)."""
        p = self._box.check(p)
        c = np.asarray(self._constant(np.atleast_2d(p).T), dtype=float).T
        return np.ascontiguousarray(c if p.ndim == 2 else c[0])

    def state_space(self, p: ArrayLike = ()) -> Any:
        """Model at one design as a `control.StateSpace` with outputs x.

        Raises
        ------
        InputError
            If the model has a constant term, for which a state space has no place, or there are several designs.
        """
        import control

        if self.affine:
            cure = "Linearise the plant about its equilibrium: linearise(plant, equilibrium(plant, p))."
            raise InputError("model", "a constant term", "a linear model", cure)
        A, B, _ = self.matrices(p)
        if A.ndim != 2:
            raise InputError("p", f"shape {np.shape(p)}", "one design")
        return control.ss(A, B, np.eye(self.nx), np.zeros((self.nx, self.nu)), self.dt)

    def within(self, design: DesignSpace) -> LinearModel:
        """This model over another box of designs."""
        return replace(self, design=design)

    def with_errors(self) -> LinearModel:
        """Model driven by (w, r), with r (nx,) added to the next state."""
        return replace(self, E=ca.horzcat(self.E, ca.SX.eye(self.nx)))

    def stepper(self, p: ArrayLike, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at design `p` (np,)."""
        A, B, E = self.matrices(p)
        c = self.constant(p)
        return lambda x, u, w: x @ A.T + u @ B.T + w @ E.T + c


def state_space_matrices(system: Any) -> tuple[Array, Array]:
    """A (nx, nx) and B (nx, nu) of a `control.StateSpace`."""
    if not all(hasattr(system, name) for name in ("A", "B", "dt")):
        cure = "Convert it with control.ss(system)." if hasattr(system, "num") else ""
        raise InputError("system", shown(system), "a control.StateSpace", cure)
    A = as_array("system.A", np.atleast_2d(system.A), ("nx", "nx"))
    B = as_array("system.B", np.atleast_2d(system.B), (len(A), "nu"))
    if A.shape[0] != A.shape[1]:
        raise InputError("system.A", f"shape {A.shape}", "a square matrix")
    return A, B


def sampling_time(system: Any, dt: float | None) -> float:
    """Sampling time [s] of a `control.StateSpace`, its own or that of a continuous one."""
    if not system.dt:
        if dt is None:
            cure = "The system is continuous: give dt, or sample it first with system.sample(dt)."
            raise InputError("dt", "nothing", "a sampling time [s]", cure)
        return as_positive("dt", dt, unit="s")
    own = as_positive("dt", 1.0 if system.dt is True else float(system.dt), unit="s")
    if dt is not None and not np.isclose(own, as_positive("dt", dt, unit="s")):
        raise InputError("dt", dt, f"{own} or nothing", f"The system is sampled at {own} s.")
    return own
