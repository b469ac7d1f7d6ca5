"""Algebraic variables of differential-algebraic equations of index 1."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse.csgraph import maximum_bipartite_matching

from ccdtools_ground.door import brief
from ccdtools_ground.errors import InputError
from ccdtools_ground.operations import JUMPS, operations, term_sizes
from ccdtools_ground.tolerances import NEWTON_STEPS, ROOT_ROUNDINGS, SINGULAR

TINY = float(np.finfo(np.float32).tiny)  # so that nothing is divided by 0, in single precision either
INDEX_ONE = "equations of index 1, which determine z: ∂g/∂z regular"


def check_index(g: Any, z: Any, guess: Any) -> None:
    """Raise an `InputError` unless g = 0 (nz, 1) determines the symbols z (nz, 1).

    By the structure of ∂g/∂z, and of scalar expressions by its value at the guess and generic values of all else.
    """
    size = z.numel()
    if g.numel() != size:
        raise InputError("algebraic", f"{g.numel()} equations", f"{size}, one for each algebraic variable")
    J = ca.jacobian(g, z)
    pattern = ca.DM(J.sparsity(), 1).sparse()
    alone = np.flatnonzero(maximum_bipartite_matching(pattern, perm_type="column") < 0)
    if len(alone):
        row = int(alone[0])
        stated = f"{brief(str(g[row]))} = 0, " * isinstance(g, ca.SX)
        what = f"{stated}which has no z{' of its own' * bool(pattern[row].nnz)}"
        cure = "It is a hidden constraint: put its derivative by time, with the dynamics in it, in its place, and so on"
        cure = f"{cure} until z appears; the start must keep what was differentiated."
        raise InputError("algebraic", f"index > 1, by equation {row + 1}, {what}", INDEX_ONE, cure)
    if isinstance(J, ca.SX):
        g, J = (ca.densify(ca.substitute(value, z, ca.SX(guess))) for value in (g, J))
        known = ca.symvar(ca.horzcat(g, J))
        at = ca.Function("at", [ca.vertcat(*known)], [g, J])
        numbers = [
            at.instruction_constant(k) for k in range(at.n_instructions()) if at.instruction_id(k) == ca.OP_CONST
        ]
        if not np.isfinite(numbers).all():
            raise InputError("z_guess", brief(str(guess)), "one at which the equations and ∂g/∂z are finite")
        generic = np.random.default_rng(0).uniform(0.5, 1.5, len(known))
        _check_regular(np.asarray(at(generic)[1], dtype=float))


def _check_regular(J: np.ndarray) -> None:
    """Raise an `InputError` where a matrix, its rows and columns scaled, is singular."""
    if not np.isfinite(J).all():  # the generic values lie outside a domain
        return
    for axis in (1, 0):
        size = np.abs(J).max(axis=axis, keepdims=True)
        J = J / np.where(size > 0, size, 1.0)
    left, values, _ = np.linalg.svd(J)
    if values[-1] > SINGULAR:
        return
    share = np.abs(left[:, -1])
    rows = ", ".join(str(i + 1) for i in np.flatnonzero(share > 0.1 * share.max()))
    cure = f"Give a `z_guess` at which it is regular, or differentiate by time what equations {rows} say without z."
    raise InputError("algebraic", f"∂g/∂z singular at `z_guess`, in equations {rows}", INDEX_ONE, cure)


def solved(g: ca.SX, z: ca.SX, guess: Any) -> ca.SX:
    """Expression (nz, 1) for the z at which g is 0.

    Block by block of ∂g/∂z in triangular form. A block that is affine in its own variables is solved, and corrected
    once; on others Newton steps are unrolled from `guess`, and what is no root to rounding is NaN. Derivatives are
    exact: two steps are made from a root (one for the first, two for the second derivatives).
    """
    check_index(g, z, guess)
    blocks, rows, columns, row_ends, column_ends, *_ = ca.jacobian(g, z).sparsity().btf()
    found, guess = ca.SX(z), ca.SX(guess)
    for k in range(blocks):
        own, unknown = (part[ends[k] : ends[k + 1]] for part, ends in ((rows, row_ends), (columns, column_ends)))
        found[unknown] = ca.substitute(_root(g[own], z[unknown], guess[unknown]), z, found)  # steps of one block alone
    return found


def _root(g: ca.SX, z: ca.SX, guess: ca.SX) -> ca.SX:
    """Expression for a zero of one block."""
    unknown = {symbol.element_hash() for symbol in ca.vertsplit(z)}
    rest = ca.vertcat(ca.SX(0, 1), *(one for one in ca.symvar(g) if one.element_hash() not in unknown))
    J = ca.jacobian(g, z)
    columns = ca.diag(1 / ca.sqrt(ca.sum1(J**2)).T)
    rows = ca.diag(1 / ca.sqrt(ca.sum2((J @ columns) ** 2)))  # with them no unit matters
    step = ca.Function("newton", [z, rest], [ca.densify(z - columns @ ca.solve(rows @ J @ columns, rows @ g))])
    if not ca.depends_on(J, z) and not operations(step) & JUMPS.keys():
        return step(step(ca.SX.zeros(z.shape), rest), rest)
    residual, scale = (ca.Function("at", [z, rest], [ca.densify(value)]) for value in (g, ca.diag(rows)))
    found = guess
    for steps in (NEWTON_STEPS - 2, 2):
        for _ in range(steps):
            found = step(found, rest)
        terms = ca.mmax(scale(found, rest) * term_sizes(residual, found, rest))
        missed = ca.mmax(ca.fabs(scale(found, rest) * residual(found, rest)))
        one = ca.fmin(1, 1 + terms)
        rounding = ca.fabs(3 * (4 / 3 * one - one) - one)  # of the arithmetic that this runs in
        found += TINY * ca.sqrt(1 - missed / (ROOT_ROUNDINGS * rounding * terms + TINY))  # NaN if missed
    return found
