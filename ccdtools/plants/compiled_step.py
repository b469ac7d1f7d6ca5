"""Runge–Kutta steps in machine code, for many samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from inspect import signature
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.budgets import KEPT_SIZES
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.casadi_operations import texts_of_operations
from ccdtools.plants.runge_kutta import ExplicitStep, slopes_of

WHOLE_SAMPLE = """
def path(states, u, w, p, du, dw, dp, c):
    for r in range(states.shape[1]):
        for k in range(states.shape[0] - 1):
            {body}
"""
BACKWARDS = """
def slopes(states, u, w, p, du, dw, dp, m, total, c):
    for r in range(states.shape[1]):
        for k in range(states.shape[0] - 2, -1, -1):
            {body}
"""

# One kind of every argument: others, such as arrays that cannot be written, would be compiled anew.
KINDS = dict.fromkeys(("du", "dw", "dp"), "int64") | {
    "states": "float64[:, :, ::1]", "m": "float64[:, ::1]", "total": "float64[:, ::1]",
    "c": "Array(float64, 1, 'C', readonly=True)",
}  # fmt: skip


def can_be_compiled(function: ca.Function) -> bool:
    """Whether every operation of a function has a text."""
    moved = (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT)
    return all(op in moved or op in texts_of_operations() for op, *_ in Vectorised(function).instructions)


def explicit_kind(function: ca.Function, compiled: bool) -> type[ExplicitStep]:
    """Kind of the explicit steps of a function."""
    return CompiledStep if compiled and can_be_compiled(function) else ExplicitStep


class CompiledStep(ExplicitStep):
    """Explicit step whose loops over runs and parts are compiled by Numba.

    The first step of a kind of plant, whatever its constants, takes a second; the others of some hundred runs down to a
    twentieth of those of arrays. Of thousands of runs powers take up to three times as long. Results differ by rounding
    at most.
    """

    few_rows = 8  # Up to so many CasADi's own machine is taken.

    def path(self, x: Array, held: tuple[Array, ...]) -> list[Array]:
        """States (nx, n) before each part of the sample and at its end."""
        states = np.empty((self.substeps + 1, *x.shape))
        states[0] = x
        with np.errstate(all="ignore"):
            _path_of(self.substep)(states, *_strided(held))
        return [state.T for state in states]

    def slopes(self, x: Array, held: tuple[Array, ...], states: list[Array], multiplier: Array) -> list[Array]:
        """Products (n, ·) of a multiplier (n, nx) with ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂w, ∂x⁺/∂p."""
        if not states:
            return super().slopes(x, held, states, multiplier)
        ends = np.cumsum([self.substep.numel_in(i) for i in range(3)])
        total = np.zeros((len(x), ends[-1] + self.substep.numel_in(3)))
        along = np.array([state.T for state in states])
        with np.errstate(all="ignore"):
            _slopes_of(self.substep)(along, *_strided(held), np.array(multiplier, dtype=float, order="C"), total)
        return np.split(total, ends, axis=1)


def _strided(held: tuple[Array, ...]) -> list[Any]:
    """Rows of u, w, p, and by how many one goes on from run to run."""
    rows = [np.ascontiguousarray(np.atleast_2d(a), dtype=float) for a in held]
    return [*rows, *(int(a.ndim == 2) for a in held)]


@lru_cache(KEPT_SIZES)
def _path_of(substep: ca.Function) -> Callable[..., None]:
    """Compiled states along a sample."""
    lines, after, constants = _instructions(substep)
    put = [f"states[k + 1, r, {i}] = {value}" for i, value in enumerate(after)]
    return partial(_compiled(WHOLE_SAMPLE, (*lines, *put), "path"), c=constants)


@lru_cache(KEPT_SIZES)
def _slopes_of(substep: ca.Function) -> Callable[..., None]:
    """Compiled adjoint along a sample, part by part from its end."""
    lines, found, constants = _instructions(slopes_of(substep))
    nx = substep.numel_in(0)
    put = [f"total[r, {i}] {'=' if i < nx else '+='} {value}" for i, value in enumerate(found)]
    back = [f"m[r, {i}] = total[r, {i}]" for i in range(nx)]
    return partial(_compiled(BACKWARDS, (*lines, *put, *back), "slopes"), c=constants)


def _instructions(function: ca.Function) -> tuple[list[str], list[str], Array]:
    """Lines of a function of (x, u, w, p) or (x, u, w, p, m), its values in them, and its constants c."""
    names = ["states[k, r, {}]", "u[r * du, {}]", "w[r * dw, {}]", "p[r * dp, {}]", "m[r, {}]"]
    numbers: list[float] = []

    def put(number: float) -> str:
        """Text of a constant: its place."""
        numbers.append(number)
        return f"c[{len(numbers) - 1}]"

    lines, values = Vectorised(function).lines(names, texts_of_operations(), "{} = {}", put)
    return lines, values[0], np.array(numbers, dtype=float)


@lru_cache(KEPT_SIZES)
def _compiled(text: str, lines: tuple[str, ...], name: str) -> Callable[..., None]:
    """Function of a text with these lines as its body."""
    from numba import njit

    known: dict[str, Any] = {"np": np}
    exec(text.format(body="\n            ".join(lines)), known)
    kinds = ", ".join(
        KINDS.get(one, "Array(float64, 2, 'C', readonly=True)") for one in signature(known[name]).parameters
    )
    compiled: Callable[..., None] = njit(f"void({kinds})", error_model="numpy")(known[name])
    return compiled
