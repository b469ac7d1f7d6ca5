"""Plant: dynamics in x, u, w and the design p."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, frozen
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.compiled_step import explicit_kind
from ccdtools.plants.design_space import DesignSpace, check_finite
from ccdtools.plants.jumps import Switches
from ccdtools.plants.runge_kutta import ExplicitStep
from ccdtools.plants.symbols import Symbolic, as_expression, as_symbols, check_distinct, check_known, check_numbers
from ccdtools_ground.algebraic import solved
from ccdtools_ground.door import as_count, as_flag, as_floats, as_instance, as_names, as_positive, shown

ABOUT_REST = (
    "Count the states and inputs of a simulator from rest, such as x_e and u_e by scipy.optimize.fsolve: "
    "BlackBox(lambda x, u, w, p: advance(x_e + x, u_e + u, w, p) - x_e, ...)."
)


@dataclass(frozen=True, eq=False, repr=False)
class Plant(Symbolic):
    """Dynamics as a CasADi expression in state, input, disturbance and design.

    Parameters
    ----------
    x, u, w, p : casadi.SX column symbols
        State (nx), input (nu), disturbance (nw), design (np). None or ``SX(0, 1)`` where there is none.
    dynamics : casadi.SX (nx, 1), or a list of nx expressions
        dx/dt if `continuous`, else the next state.
    design : DesignSpace
        Bounds and units of p.
    dt : float
        Sampling time [s]; inputs and disturbances are held constant over it (zero-order hold).
    continuous : bool
        Whether `dynamics` is a derivative.
    substeps : int
        Runge–Kutta steps per sample, for simulating a continuous plant.
    compiled : bool
        Whether simulations of many runs are compiled by Numba: some seconds once, then many times as fast.
    state_names, input_names : sequence of str, optional
        Labels with units, for figures.
    outputs : casadi.SX (ny, 1), or a list of ny expressions, optional
        y = h(x, u, p): what is measured, limited, or judged beside the states.
    output_names : sequence of str, optional
        Labels with units.
    output_limits : (lower, upper), optional
        Of the outputs, each a number or (ny,); infinite where there is none.
    z : casadi.SX (nz, 1), optional
        Symbols of algebraic variables in `dynamics` and `outputs`. They are replaced by what `algebraic` says of them:
        exactly where it is explicit or affine in z, block by block, else by Newton steps from `z_guess`, NaN where
        these do not come near a root.
    algebraic : casadi.SX (nz, 1), or a list of nz expressions, optional
        g(x, z, u, w, p) = 0, of index 1: ∂g/∂z is regular.
    z_guess : (nz,) numbers, or expressions in x, u, w, p, optional
        Where Newton's method starts; 0 by default.

    Raises
    ------
    InputError
        If a symbol is not symbolic or used twice, shapes disagree, `dynamics` has other free symbols or an operation
        that arrays do not have; if the algebraic equations have an index above 1, or ∂g/∂z is singular at the guess.
    """

    symbol_fields: ClassVar[tuple[str, ...]] = ("x", "u", "w", "p")
    expression_fields: ClassVar[tuple[str, ...]] = ("dynamics", "outputs")

    x: ca.SX
    u: ca.SX
    w: ca.SX
    p: ca.SX
    dynamics: ca.SX
    design: DesignSpace
    dt: float
    continuous: bool = True
    substeps: int = 10
    state_names: Sequence[str] = ()
    input_names: Sequence[str] = ()
    outputs: Any = ()
    output_names: Sequence[str] = ()
    output_limits: Any = None
    compiled: bool = False
    z: InitVar[Any] = None
    algebraic: InitVar[Any] = ()
    z_guess: InitVar[Any] = 0.0

    def __post_init__(self, z: Any, algebraic: Any, z_guess: Any) -> None:
        self._set(**{name: as_symbols(name, getattr(self, name)) for name in ("x", "u", "w", "p")})
        z = as_symbols("z", z)
        check_distinct(x=self.x, u=self.u, w=self.w, p=self.p, z=z)
        if not z.is_empty() or as_expression("algebraic", algebraic).numel():
            self._substitute(z, algebraic, z_guess)
        if self.nx == 0:
            raise InputError("x", "no state", "at least one")
        self._set(dynamics=as_expression("dynamics", self.dynamics))
        if self.dynamics.shape != (self.nx, 1):
            raise InputError("dynamics", f"shape {self.dynamics.shape}", f"({self.nx}, 1), one row per state")
        check_known("dynamics", self.dynamics, x=self.x, u=self.u, w=self.w, p=self.p)
        check_numbers("dynamics", self.dynamics)
        as_instance("design", self.design, DesignSpace, "a DesignSpace")
        if self.p.numel() != self.design.dim:
            names = ", ".join(self.design.names) or "none"
            raise InputError("p", f"{self.p.numel()} symbols", f"{self.design.dim} ({names}), one per design parameter")
        self._set(dt=as_positive("dt", self.dt, unit="s"))
        self._set(continuous=as_flag("continuous", self.continuous))
        self._set(substeps=as_count("substeps", self.substeps), compiled=as_flag("compiled", self.compiled))
        self._check_outputs()
        named = (("state_names", "x", self.nx), ("input_names", "u", self.nu), ("output_names", "y", self.ny))
        self._set(**{name: as_names(name, getattr(self, name), n, letter) for name, letter, n in named})
        Vectorised(self.right_hand_side)  # refuses operations that have no array counterpart

    def _substitute(self, z: ca.SX, algebraic: Any, guess: Any) -> None:
        """Put what the algebraic equations say of z in its place."""
        known = {"x": self.x, "u": self.u, "w": self.w, "p": self.p}
        g, guess = as_expression("algebraic", algebraic), as_expression("z_guess", guess)
        check_known("algebraic", g, **known, z=z)
        check_numbers("algebraic", g)
        check_known("z_guess", guess, **known)
        check_numbers("z_guess", guess)
        guess = ca.SX.ones(z.shape) * guess if guess.numel() == 1 else guess
        if guess.shape != z.shape:
            raise InputError("z_guess", f"shape {guess.shape}", f"{z.shape}, one for each algebraic variable")
        found = solved(g, z, guess)
        for name in ("dynamics", "outputs"):
            stated = as_expression(name, () if getattr(self, name) is None else getattr(self, name))
            self._set(**{name: ca.substitute(stated, z, found)})

    def _check_outputs(self) -> None:
        """Raise an `InputError` unless outputs and their limits are valid."""
        given = () if self.outputs is None else self.outputs
        none = given.is_empty() if isinstance(given, ca.SX) else isinstance(given, tuple | list) and not given
        y = ca.SX(0, 1) if none else as_expression("outputs", given)
        if y.shape[1] != 1:
            raise InputError("outputs", f"shape {y.shape}", "a column of expressions (ny, 1)")
        check_known("outputs", y, x=self.x, u=self.u, p=self.p)
        check_numbers("outputs", y)
        self._set(outputs=y)
        given = (-np.inf, np.inf) if self.output_limits is None else self.output_limits
        if not isinstance(given, tuple | list) or len(given) != 2:
            raise InputError("output_limits", shown(given), "bounds (lower, upper)")
        low, high = (_bound(f"output_limits, {side}", value, self.ny) for side, value in zip(("lower", "upper"), given))
        if not (low < high).all():
            raise InputError("output_limits", f"{low.tolist()} and {high.tolist()}", "lower < upper")
        self._set(output_limits=(low, high))

    def __repr__(self) -> str:
        kind = f"continuous, sampled every {self.dt:g} s" if self.continuous else f"discrete, dt = {self.dt:g} s"
        return f"Plant({self.nx} states, {self.nu} inputs, {self.nw} disturbances, {kind}, design: {self.design!r})"

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.x.numel()

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.u.numel()

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.w.numel()

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.outputs.numel())

    @cached_property
    def output(self) -> ca.Function:
        """(x, u, p) → y."""
        return ca.Function("outputs", [self.x, self.u, self.p], [self.outputs], ["x", "u", "p"], ["y"])

    def observe(self, x: ArrayLike, u: ArrayLike, p: ArrayLike = ()) -> Array:
        """Outputs (..., ny) of states (..., nx) and inputs (..., nu) at a design."""
        x, u = as_floats("x", x), as_floats("u", u)
        for name, value, size in (("x", x, self.nx), ("u", u, self.nu)):
            if value.ndim == 0 or value.shape[-1] != size:
                raise InputError(name, f"shape {value.shape}", f"(..., {size})")
        if self.ny == 0:
            return np.zeros((*np.broadcast_shapes(x.shape[:-1], u.shape[:-1]), 0))
        return np.asarray(Vectorised(self.output)(x, u, self.design.check_one(p)))

    @cached_property
    def nonlinear_states(self) -> tuple[str, ...]:
        """Names of states with dynamics not affine in x, u and w.

        Whatever may jump there counts, though its derivative is constant.
        """
        z = ca.vertcat(self.x, self.u, self.w)
        J = ca.jacobian(self.dynamics, z)
        switched = self.switches.names
        return tuple(name for i, name in enumerate(self.state_names) if switched[i] or ca.depends_on(J[i, :], z))

    @cached_property
    def switches(self) -> Switches:
        """Operations that may jump in x, u or w."""
        return Switches(self.right_hand_side)

    @property
    def linear(self) -> bool:
        """Whether the dynamics are affine in x, u and w."""
        return not self.nonlinear_states

    @cached_property
    def right_hand_side(self) -> ca.Function:
        """(x, u, w, p) → dynamics."""
        return ca.Function("dynamics", [self.x, self.u, self.w, self.p], [self.dynamics], [*"xuwp"], ["dynamics"])

    @cached_property
    def step(self) -> ca.Function:
        """(x, u, w, p) → next state; by Runge–Kutta 4 if continuous.

        The error per sample is O(dt⁵/substeps⁴).
        """
        return self.explicit_step.function

    def stepper(self, p: Array, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at design `p`."""
        return self.explicit_step.at(p)

    @cached_property
    def for_many_runs(self) -> Plant:
        """This plant, compiled; always the same object."""
        return self if self.compiled else replace(self, compiled=True)

    @cached_property
    def explicit_step(self) -> ExplicitStep:
        """`step` on arrays of any number of runs."""
        f = self.right_hand_side
        kind = explicit_kind(f, self.compiled)
        return kind.of(f, self.dt, self.substeps) if self.continuous else kind(f, 1)


def linear_matrices(plant: Plant) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """∂f/∂x, ∂f/∂u, ∂f/∂w and constant term of linear dynamics f.

    Raises
    ------
    InputError
        If they are not linear in x, u and w, or not finite.
    """
    if not plant.linear:
        got = f"dynamics nonlinear in x, u or w for {', '.join(plant.nonlinear_states)}"
        if plant.switches:
            got += f", with {', '.join(sorted(set().union(*plant.switches.names)))}"
        raise InputError("plant", got, "linear ones", "Linearise it: linearise(plant, equilibrium(plant, p)).")
    z = ca.vertcat(plant.x, plant.u, plant.w)
    M = ca.jacobian(plant.dynamics, z)
    rest = ca.Function("rest", [z, plant.p], [plant.dynamics])(ca.SX.zeros(z.shape), plant.p)
    constant = ca.densify(ca.simplify(rest))
    check_finite(ca.Function("M", [plant.p], [ca.densify(ca.horzcat(M, constant))]), plant.design, "the dynamics")
    nx = plant.nx
    nu = plant.nu
    return M[:, :nx], M[:, nx : nx + nu], M[:, nx + nu :], constant


def _bound(argument: str, value: Any, size: int) -> Array:
    """Bound of the outputs on one side (size,), possibly infinite."""
    bound = as_floats(argument, value)
    if bound.shape not in ((), (size,)) or np.isnan(bound).any():
        raise InputError(argument, f"{bound.tolist()} of shape {bound.shape}", f"a number, or ({size},) of them")
    return frozen(np.broadcast_to(bound, (size,)).copy())
