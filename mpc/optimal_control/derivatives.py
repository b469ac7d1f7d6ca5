"""Values and derivatives of a nonlinear program from its pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.optimal_control.pieces import Numbers, Piece


class Derivatives:
    """Cost f, constraints g (m,) of unknowns v (n,), and derivatives."""

    def __init__(self, pieces: Sequence[Piece], unknowns: int, constraints: int) -> None:
        self.pieces = merged(pieces)
        self.n = unknowns
        self.m = constraints
        self.solvers: dict[Any, Any] = {}
        self.statements: dict[bytes, Any] = {}
        self.v = ca.MX.sym("v", unknowns)
        self.f: ca.MX = self._gathered(True)
        self.g: ca.MX = self._gathered(False)

    def _values(self, of_cost: bool) -> Iterator[tuple[Piece, list[Any], Any, Numbers]]:
        """Pieces with their symbols, their values in the cost or the constraints, and the rows (k, M) of these."""
        for piece in self.pieces:
            chosen = piece.of_cost == of_cost
            if chosen.any():
                z, data = piece.symbols
                value = piece.function(z, data)[np.flatnonzero(chosen).tolist()]
                yield piece, [z, data], value * ca.DM(piece.factors[chosen]), piece.rows[chosen] - (not of_cost)

    def _gathered(self, of_cost: bool) -> Any:
        """Expression of f or g as the sum of its values."""
        first = np.zeros((1, 1), dtype=np.int64)
        terms = ((piece, own, value, rows, first) for piece, own, value, rows in self._values(of_cost))
        return ca.densify(self._summed((1 if of_cost else self.m, 1), terms))

    def _slope(self, of_cost: bool) -> Any:
        """Expression of ∂f/∂v or ∂g/∂v."""
        terms = (
            (piece, own, ca.jacobian(value, own[0]), rows, piece.unknowns)
            for piece, own, value, rows in self._values(of_cost)
        )
        return self._summed((1 if of_cost else self.m, self.n), terms)

    def _summed(self, shape: tuple[int, int], terms: Iterable[tuple[Any, ...]], *, upper: bool = False) -> Any:
        """Sparse matrix that is a sum of matrices of pieces.

        Terms are a piece, its symbols, a matrix of these, the rows (·, M) and columns (·, M) of the sum that it is
        added to, mirrored into the upper triangle if asked for, and values of symbols besides z and data.
        """
        parts, places = [ca.MX(0, 1)], [np.zeros((2, 0), dtype=np.int64)]
        for piece, symbols, matrix, rows, columns, *given in terms:
            if not matrix.nnz():
                continue
            function = ca.Function("entries", symbols, [ca.densify(matrix.nz[:])], {"cse": True})
            z = ca.reshape(self.v[piece.unknowns.ravel(order="F").tolist()], *piece.unknowns.shape)
            parts.append(ca.vec((function.map(piece.places) if piece.places > 1 else function)(z, piece.data, *given)))
            row, column = matrix.sparsity().get_triplet()
            pair = np.stack(np.broadcast_arrays(rows[row], columns[column]))
            places.append((np.sort(pair, axis=0) if upper else pair).transpose(0, 2, 1).reshape(2, -1))
        row, column = np.hstack(places)
        cells, where = np.unique(column * shape[0] + row, return_inverse=True)  # by columns, as CasADi keeps them
        gather = ca.Sparsity(len(cells), len(where), list(range(len(where) + 1)), where.tolist())
        pattern = ca.Sparsity.triplet(*shape, (cells % shape[0]).tolist(), (cells // shape[0]).tolist())
        return ca.MX(pattern, ca.densify(ca.mtimes(ca.DM(gather, 1.0), ca.vertcat(*parts))))

    @cached_property
    def values(self) -> ca.Function:
        """Function v → f, g."""
        return ca.Function("values", [self.v], [self.f, self.g])

    @cached_property
    def stationarity(self) -> ca.Function:
        """Function v, λ → g, ∇(f + λ'g), ∇f by reverse mode."""
        multipliers = ca.MX.sym("multipliers", self.m)
        slope = ca.gradient(self.f + ca.dot(multipliers, self.g), self.v)
        return ca.Function("stationarity", [self.v, multipliers], [self.g, slope, ca.gradient(self.f, self.v)])

    @cached_property
    def jacobian(self) -> tuple[ca.Function, ca.Function]:
        """Functions v → (f, ∇f) and v → (g, ∂g/∂v)."""
        of_cost = ca.Function("grad_f", [self.v], [self.f, ca.densify(self._slope(True).T)])
        return of_cost, ca.Function("jac_g", [self.v], [self.g, self._slope(False)])

    @cached_property
    def hessian(self) -> ca.Function:
        """Function v, σ, λ → upper triangle of the Hessian."""
        of_cost, multipliers = ca.MX.sym("of_cost"), ca.MX.sym("multipliers", self.m)
        all_of_them = ca.vertcat(of_cost, multipliers)

        def curved(piece: Piece) -> tuple[Any, ...]:
            z, data = piece.symbols
            weights = type(z).sym("weights", len(piece.factors))
            value = ca.dot(weights * ca.DM(piece.factors), piece.function(z, data))
            given = ca.reshape(all_of_them[piece.rows.ravel(order="F").tolist()], *piece.rows.shape)
            own = [z, data, weights]
            return piece, own, ca.triu(ca.hessian(value, z)[0]), piece.unknowns, piece.unknowns, given

        whole = self._summed((self.n, self.n), map(curved, self.pieces), upper=True)
        return ca.Function("hess_lag", [self.v, of_cost, multipliers], [whole])

    def scaled(self, kept: Any) -> tuple[Any, dict[str, ca.Function]]:
        """Program for Ipopt with `kept` rows, made once."""
        if kept.tobytes() not in self.statements:
            self.statements[kept.tobytes()] = self._scaled(kept)
        return self.statements[kept.tobytes()]  # type: ignore[no-any-return]

    def _scaled(self, kept: Any) -> tuple[Any, dict[str, ca.Function]]:
        """Program in z = (v − a) / s, cost / c and `kept` rows (g − b) / r for Ipopt.

        Its parameters are (s, a, c, r, b): sizes change without building anew. Ipopt factorises rows without a bound,
        too.
        """
        z, given = ca.MX.sym("x", self.n), ca.MX.sym("p", 2 * (self.n + len(kept)) + 1)
        of_cost, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", len(kept))
        s, a, c, r, b = ca.vertsplit(given, np.cumsum([0, self.n, self.n, 1, len(kept), len(kept)]).tolist())
        v, own = a + z * s, np.asarray(kept).tolist()
        f, g = (ca.Function(name, [self.v], [value])(v) for name, value in (("f", self.f), ("g", self.g)))
        (with_slope, slope), (with_jacobian, whole) = (function(v) for function in self.jacobian)
        g, with_jacobian, whole, on_rows = g[own] - b, with_jacobian[own] - b, whole[own, :], ca.MX.zeros(self.m)
        on_rows[own] = multipliers / r
        curvature = self.hessian(v, of_cost / c, on_rows)
        rows, columns = whole.sparsity().get_triplet()
        jacobian = ca.MX(whole.sparsity(), ca.vec(whole.nz[:]) * ca.vec(s[columns]) / ca.vec(r[rows]))
        first, second = curvature.sparsity().get_triplet()
        hessian = ca.MX(curvature.sparsity(), ca.vec(curvature.nz[:]) * ca.vec(s[first]) * ca.vec(s[second]))
        names = ["x", "p"]
        functions = {
            "grad_f": ca.Function("nlp_grad_f", [z, given], [with_slope / c, slope * s / c], names, ["f", "grad_f_x"]),
            "jac_g": ca.Function("nlp_jac_g", [z, given], [with_jacobian / r, jacobian], names, ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "nlp_hess_l", [z, given, of_cost, multipliers], [hessian], [*names, "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            ),
        }  # fmt: skip
        return {"x": z, "p": given, "f": f / c, "g": g / r}, functions


def merged(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """Pieces with those of one function and equal factors as one.

    Then those of scalar instructions that differ in constants and factors alone: these become data. Constants that are
    the same everywhere, such as 0 and 1, stay, and with them what is known of derivatives that vanish.
    """
    same = _grouped(pieces, lambda piece: (_written(piece.function), piece.factors.tobytes(), piece.of_cost.tobytes()))
    alike = _grouped([_as_one(group) for group in same], _kind)
    found: list[Piece] = []
    for group in alike:
        found += [_lifted(few) for few in _grouped(group, _structure)] if len(group) > 1 else group
    return tuple(found)


def _grouped(pieces: Sequence[Piece], key: Callable[[Piece], Any]) -> list[list[Piece]]:
    """Pieces of each key."""
    groups: dict[Any, list[Piece]] = {}
    for piece in pieces:
        groups.setdefault(key(piece), []).append(piece)
    return list(groups.values())


def _as_one(group: list[Piece]) -> Piece:
    """One piece at all places."""
    unknowns, data, rows = (np.hstack([getattr(one, name) for one in group]) for name in ("unknowns", "data", "rows"))
    return Piece(group[0].function, unknowns, data, rows, group[0].factors)


def _written(function: ca.Function) -> Any:
    """Key shared by equal functions."""
    try:
        return function.serialize()
    except RuntimeError:  # of a function that is no expression
        return id(function)


def _kind(piece: Piece) -> Any:
    """Key shared by pieces that may differ in constants alone."""
    function = piece.function
    if not function.is_a("SXFunction"):
        return id(piece)
    return function.n_instructions(), len(piece.unknowns), len(piece.data), piece.of_cost.tobytes()


def _structure(piece: Piece) -> Any:
    """Instructions of a function without the values of constants."""
    f = piece.function
    steps = range(f.n_instructions())
    return tuple((f.instruction_id(i), *f.instruction_input(i), *f.instruction_output(i)) for i in steps)


def _lifted(group: list[Piece]) -> Piece:
    """One piece whose differing constants and factors are data."""
    if len(group) == 1:
        return group[0]
    first = group[0]
    at = [i for i in range(first.function.n_instructions()) if first.function.instruction_id(i) == ca.OP_CONST]
    constants = np.array([[piece.function.instruction_constant(i) for i in at] for piece in group])
    factors = np.array([piece.factors for piece in group])
    own, weighed = (np.flatnonzero((values != values[0]).any(axis=0)) for values in (constants, factors))
    given = np.hstack([constants[:, own], factors[:, weighed]])
    function = _replayed(first, [at[i] for i in own], weighed.tolist())
    ones = first.factors.copy()
    ones[weighed] = 1.0
    return _as_one([
        Piece(function, piece.unknowns, np.vstack([piece.data, np.tile(values[:, None], (1, piece.places))]),
              piece.rows, ones)
        for piece, values in zip(group, given)
    ])  # fmt: skip


def _replayed(piece: Piece, constants: list[int], factors: list[int]) -> ca.Function:
    """Function of a piece with some constants and factors as data."""
    function, start = piece.function, len(piece.data)
    z, data = ca.SX.sym("z", len(piece.unknowns)), ca.SX.sym("data", start + len(constants) + len(factors))
    place = {i: start + k for k, i in enumerate(constants)}
    weight = {i: start + len(constants) + k for k, i in enumerate(factors)}
    work: list[Any] = [ca.SX(0)] * function.sz_w()
    values: list[Any] = [ca.SX(0)] * len(piece.factors)
    for i in range(function.n_instructions()):
        kind, into, of = function.instruction_id(i), function.instruction_output(i), function.instruction_input(i)
        if kind == ca.OP_INPUT:
            work[into[0]] = (z, data)[of[0]][of[1]]
        elif kind == ca.OP_OUTPUT:
            entry = into[1]
            values[entry] = work[of[0]] * data[weight[entry]] if entry in weight else work[of[0]]
        elif kind == ca.OP_CONST:
            work[into[0]] = data[place[i]] if i in place else ca.SX(function.instruction_constant(i))
        elif len(of) == 1:
            work[into[0]] = ca.SX.unary(kind, work[of[0]])
        else:
            work[into[0]] = ca.SX.binary(kind, work[of[0]], work[of[1]])
    return ca.Function("piece", [z, data], [ca.densify(ca.vertcat(*values))], ["z", "data"], ["value"], {"cse": True})
