"""A plant, stated once: dynamics in x, u, w and the design p."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.checks import as_count, as_flag, as_instance, as_names, as_positive
from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.symbols import as_expression, as_symbols, check_distinct, check_known, pack, unpack

NATIVE_BATCH = 8  # below this, CasADi's own machine is faster than one array operation per instruction


@dataclass(frozen=True, eq=False, repr=False)
class Plant:
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
    state_names, input_names : sequence of str, optional
        Labels with units, for figures.

    Raises
    ------
    InputError
        If a symbol is not symbolic or used twice, shapes disagree, `dynamics` has other free symbols or an operation
        that arrays do not have.
    """

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

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        for name in ("x", "u", "w", "p"):
            set_(self, name, as_symbols(name, getattr(self, name)))
        check_distinct(x=self.x, u=self.u, w=self.w, p=self.p)
        if self.nx == 0:
            raise InputError("x", "no state", "at least one")
        set_(self, "dynamics", as_expression("dynamics", self.dynamics))
        if self.dynamics.shape != (self.nx, 1):
            raise InputError("dynamics", f"shape {self.dynamics.shape}", f"({self.nx}, 1), one row per state")
        check_known("dynamics", self.dynamics, x=self.x, u=self.u, w=self.w, p=self.p)
        as_instance("design", self.design, DesignSpace, "a DesignSpace")
        if self.p.numel() != self.design.dim:
            names = ", ".join(self.design.names) or "none"
            raise InputError("p", f"{self.p.numel()} symbols", f"{self.design.dim} ({names}), one per design parameter")
        set_(self, "dt", as_positive("dt", self.dt, unit="s"))
        set_(self, "continuous", as_flag("continuous", self.continuous))
        set_(self, "substeps", as_count("substeps", self.substeps))
        for name, letter, n in (("state_names", "x", self.nx), ("input_names", "u", self.nu)):
            given = getattr(self, name)
            set_(self, name, _labels(letter, n) if isinstance(given, tuple) and not given else as_names(name, given, n))
        Vectorised(self.right_hand_side)  # refuses operations that have no array counterpart

    def __repr__(self) -> str:
        kind = f"continuous, sampled every {self.dt:g} s" if self.continuous else f"discrete, dt = {self.dt:g} s"
        return f"Plant({self.nx} states, {self.nu} inputs, {self.nw} disturbances, {kind}, design: {self.design!r})"

    def __getstate__(self) -> dict[str, Any]:
        return {"expressions": pack([self.x, self.u, self.w, self.p], [self.dynamics])} | {
            name: getattr(self, name)
            for name in ("design", "dt", "continuous", "substeps", "state_names", "input_names")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        symbols, (dynamics,) = unpack(state.pop("expressions"))
        named = dict(zip(("x", "u", "w", "p"), symbols), dynamics=dynamics)
        for name, value in (named | state).items():
            object.__setattr__(self, name, value)

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

    @cached_property
    def right_hand_side(self) -> ca.Function:
        """(x, u, w, p) → dynamics."""
        return ca.Function("dynamics", [self.x, self.u, self.w, self.p], [self.dynamics])

    @cached_property
    def step(self) -> ca.Function:
        """(x, u, w, p) → next state: Runge–Kutta 4 over one held sample if continuous.

        The error per sample is O(dt⁵/substeps⁴).
        """
        if not self.continuous:
            return self.right_hand_side
        f = self.right_hand_side
        h = self.dt / self.substeps
        x = self.x
        held = (self.u, self.w, self.p)
        for _ in range(self.substeps):
            k1 = f(x, *held)
            k2 = f(x + h / 2 * k1, *held)
            k3 = f(x + h / 2 * k2, *held)
            k4 = f(x + h * k3, *held)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return ca.Function("step", [self.x, *held], [ca.densify(x)])

    def stepper(self, p, *, batch: int) -> Callable:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at design `p` (np,), for batches of n = `batch`."""
        if batch == 1 and min(self.nu, self.nw, np.size(p)) > 0:
            return self._single_step(p)
        if batch < NATIVE_BATCH:
            native = self.step
            return lambda x, u, w: np.asarray(native(x.T, u.T, w.T, p), dtype=float).T
        vectorised = self._vectorised_step
        return lambda x, u, w: vectorised(x, u, w, p)

    def _single_step(self, p: Array) -> Callable:
        """`stepper` for one run, through a buffer: a call of CasADi costs more than what it computes here."""
        made: Any = self.step.buffer()
        buffer, evaluate = made
        arguments = [*(np.zeros(size) for size in (self.nx, self.nu, self.nw)), np.array(p, dtype=float).ravel()]
        result = np.zeros(self.nx)
        views: list[Any] = [memoryview(array) for array in (*arguments, result)]  # type: ignore[arg-type]
        for i, view in enumerate(views[:-1]):
            buffer.set_arg(i, view)
        buffer.set_res(0, views[-1])

        def step(*given: Array, owner: Any = buffer) -> Array:
            """x⁺ (1, nx) of x (1, nx), u (1, nu) and w (1, nw); it keeps the owner of the memory alive."""
            for argument, value in zip(arguments, given):
                argument[:] = value[0]
            evaluate()
            return result[None].copy()

        return step

    @cached_property
    def _vectorised_step(self) -> Vectorised:
        """`step` on batches of arrays."""
        return Vectorised(self.step)


def _labels(letter: str, n: int) -> tuple[str, ...]:
    """Names such as x1, x2."""
    return tuple(f"{letter}{i + 1}" for i in range(n))
