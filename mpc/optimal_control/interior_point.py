"""Interior-point method of so many steps as an expression, for generated C."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from mpc.tolerances import NEGLIGIBLE, SOLVERS


def interior_point(
    H: ca.Sparsity, E: ca.Sparsity, G: ca.Sparsity, order: Sequence[int], *, steps: int = 50, outset: float = 10.0
) -> ca.Function:  # fmt: skip
    """Function of (H, g, E, e, G, k, size) to z and its residual.

    z is where ½ z'Hz + g'z is least with Ez = e and Gz ≤ k, G with rows. Its units should give H about 1 on its
    diagonal, and `size` says how large it is expected. Steps are centred as by Mehrotra (SIAM Journal on Optimization
    2, 1992), each by one LDL factorisation of a quasidefinite matrix (Vanderbei, SIAM Journal on Optimization 5, 1995),
    in this order of entries of z and then rows of E. The first is from rooms and pushes of `outset` times the largest
    data; the best is returned. The residual is the norm of what rows are passed by and of products of pushes and room,
    in units of the largest of `size`, e and what z = 0 passes, and of the gradient beside the largest of g.
    """
    n, equal, rows = H.size1(), E.size1(), G.size1()
    shapes: dict[str, Any] = {"H": H, "g": n, "E": E, "e": equal, "G": G, "k": rows}
    given = [ca.MX.sym(name, shape) for name, shape in shapes.items()]
    now, best, least = ca.MX.sym("now", n + equal + 2 * rows), ca.MX.sym("best", n), ca.MX.sym("least")
    expected = ca.MX.sym("size")
    stated, moved = _step(shapes, n, equal, rows)
    size = ca.fmax(ca.norm_inf(ca.vertcat(expected, given[3], ca.fmin(given[5], 0.0))), NEGLIGIBLE**2)
    sized = [one / size if name in "gek" else one for name, one in zip(shapes, given)]
    matrix, right, residual, z = stated(now, *given)
    nearer = residual < least
    moves = ca.solve(matrix[order, order], right[order, :], "ldl", {"preordering": False})
    after = moved(now, *given, moves[np.argsort(order).tolist(), :])
    results = [after, ca.if_else(nearer, z, best), ca.if_else(nearer, residual, least), nearer]
    step = ca.Function("interior_step", [now, best, least, *given], results)
    done = ca.Function("done", [now, best, least, *given], [now, best, least, 0])
    until_done = ca.Function.if_else("until_done", step, done)
    far = outset * ca.fmax(ca.norm_inf(sized[1]), 1.0)
    first = ca.vertcat(ca.DM.zeros(n + equal), ca.fmax(sized[-1], far), far * ca.DM.ones(rows))
    at: Any = [first, ca.DM.zeros(n), ca.inf, 1]
    for _ in range(steps):  # to a residual of `SOLVERS`, and on as long as it falls
        at = until_done(ca.logic_or(at[2] > SOLVERS, at[3]), *at[:3], *sized)
    results = [size * at[1], at[2]]
    return ca.Function("interior_point", [*given, expected], results, [*shapes, "size"], ["z", "residual"])


def _step(shapes: dict[str, Any], n: int, equal: int, rows: int) -> tuple[ca.Function, ca.Function]:
    """What a step solves, with residual and z, and where it leads."""
    H, g, E, e, G, k = data = [ca.MX.sym(name, shape) for name, shape in shapes.items()]
    now, moves = ca.MX.sym("now", n + equal + 2 * rows), ca.MX.sym("moves", n + equal, 2)
    z, costates, room, pushes = ca.vertsplit(now, np.cumsum([0, n, equal, rows, rows]).tolist())
    gradient, gaps, over = H @ z + g + E.T @ costates + G.T @ pushes, E @ z - e, G @ z + room - k
    residual = ca.norm_2(ca.vertcat(gradient / ca.fmax(ca.norm_inf(g), 1.0), gaps, over, room * pushes))
    curved = H + G.T @ ca.diag(pushes / room) @ G + NEGLIGIBLE**2 * ca.MX.eye(n)
    matrix = ca.blockcat([[curved, E.T], [E, -(NEGLIGIBLE**2) * ca.MX.eye(equal)]])
    # towards the optimum, and towards the centre
    right = ca.blockcat([[-gradient - G.T @ (pushes * over / room - pushes), -G.T @ (1 / room)],
                         [-gaps, ca.MX(equal, 1)]])  # fmt: skip
    stated = ca.Function("stated", [now, *data], [matrix, right, residual, z], {"cse": True})

    rooms = ca.horzcat(-over, ca.MX(rows, 1)) - G @ moves[:n, :]
    pushed = ca.horzcat(-pushes - pushes * rooms[:, 0] / room, (1 - pushes * rooms[:, 1]) / room)

    def longest(of_room: Any, of_pushes: Any) -> Any:
        """Longest step to the nearest bound, 1 at most."""
        return 1 / ca.fmax(1.0, ca.mmax(ca.vertcat(-of_room / room, -of_pushes / pushes)) / 0.99)

    part = longest(rooms[:, 0], pushed[:, 0])
    product = ca.dot(room, pushes)
    left = ca.dot(room + part * rooms[:, 0], pushes + part * pushed[:, 0])
    weights = ca.vertcat(1.0, product / rows * (left / product) ** 3)
    whole = ca.vertcat(moves, rooms, pushed) @ weights
    part = longest(*ca.vertsplit(whole[n + equal :], rows))
    return stated, ca.Function("moved", [now, *data, moves], [now + part * whole], {"cse": True})
