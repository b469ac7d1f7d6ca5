"""A plant, stated once: dynamics in x, u, w and the design p."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.design_space import DesignSpace

NATIVE_BATCH = 8  # below this, CasADi's own machine is faster than one array operation per instruction


@dataclass(frozen=True, eq=False)
class Plant:
    """Dynamics as a CasADi expression in state, input, disturbance and design.

    Parameters
    ----------
    x, u, w, p : casadi.SX column symbols
        State (nx), input (nu), disturbance (nw, may be empty: ``SX(0, 1)``), design (np).
    dynamics : casadi.SX (nx, 1)
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
        If a symbol is not symbolic, shapes disagree, or `dynamics` has other free symbols.
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
        for name in ("x", "u", "w", "p"):
            symbol = getattr(self, name)
            if not isinstance(symbol, ca.SX) or not (symbol.is_empty() or symbol.is_valid_input()):
                raise InputError(f"plant {name}: got {type(symbol).__name__}, expected a casadi.SX symbol (SX.sym).")
        dynamics = ca.SX(self.dynamics)
        if dynamics.shape != (self.nx, 1):
            raise InputError(f"plant dynamics: got shape {dynamics.shape}, expected ({self.nx}, 1), one row per state.")
        if self.p.numel() != self.design.dim:
            raise InputError(
                f"plant p: got {self.p.numel()} symbols, expected {self.design.dim} ({', '.join(self.design.names)})."
            )
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"plant dt: got {self.dt}, expected a positive time in seconds.")
        if self.substeps < 1:
            raise InputError(f"plant substeps: got {self.substeps}, expected at least 1.")
        known = ca.vertcat(self.x, self.u, self.w, self.p)
        foreign = [s.name() for s in ca.symvar(dynamics) if not ca.depends_on(known, s)]
        if foreign:
            raise InputError(f"plant dynamics: got unknown symbols {foreign}, expected only those of x, u, w and p.")
        object.__setattr__(self, "dynamics", ca.densify(dynamics))
        object.__setattr__(self, "state_names", tuple(self.state_names) or _labels("x", self.nx))
        object.__setattr__(self, "input_names", tuple(self.input_names) or _labels("u", self.nu))

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
        f, h, x = self.right_hand_side, self.dt / self.substeps, self.x
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
        if batch < NATIVE_BATCH:
            native = self.step
            return lambda x, u, w: np.asarray(native(x.T, u.T, w.T, p), dtype=float).T
        vectorised = self._vectorised_step
        return lambda x, u, w: vectorised(x, u, w, p)

    @cached_property
    def _vectorised_step(self) -> Vectorised:
        return Vectorised(self.step)


def _labels(letter: str, n: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(n))
