"""Interior-point method of so many steps as an expression, for generated C."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpc.tolerances import KKT, NEGLIGIBLE, SOLVERS, VIOLATION_PRICE


def interior_point(H: ca.Sparsity, E: ca.Sparsity, G: ca.Sparsity, steps: int = 50) -> ca.Function:
    """Function of (H, g, E, e, G, k) to z and its residual.

    z is where ½ z'Hz + g'z is least with Ez = e and Gz ≤ k, G with rows. Steps are centred as by Mehrotra (SIAM Journal
    on Optimization 2, 1992), each by one LDL factorisation, of a quasidefinite matrix (Vanderbei, SIAM Journal on
    Optimization 5, 1995); the best is returned. The residual is the norm of the gradient, of what rows are passed by,
    and of products of multipliers and room, beside the largest of g, e and what z = 0 passes. Units of z should give H
    about 1 on its diagonal.
    """
    n, equal, rows = H.size1(), E.size1(), G.size1()
    shapes: dict[str, Any] = {"H": H, "g": n, "E": E, "e": equal, "G": G, "k": rows}
    given = [ca.MX.sym(name, shape) for name, shape in shapes.items()]
    now, best, least = ca.MX.sym("now", n + equal + 2 * rows), ca.MX.sym("best", n), ca.MX.sym("least")
    stated, moved = _step(shapes, n, equal, rows)
    asked = ca.vertcat(given[1], given[3], ca.fmin(given[5], 0.0))
    size = ca.fmax(ca.norm_inf(asked), NEGLIGIBLE**2)
    sized = [one / size if name in "gek" else one for name, one in zip(shapes, given)]
    matrix, right, residual, z = stated(now, *given)
    nearer = residual < least
    after = moved(now, *given, ca.solve(matrix, right, "ldl"))
    results = [after, ca.if_else(nearer, z, best), ca.if_else(nearer, residual, least)]
    step = ca.Function("interior_step", [now, best, least, *given], results)
    done = ca.Function("done", [now, best, least, *given], [now, best, least])
    until_done = ca.Function.if_else("until_done", step, done)
    first = ca.vertcat(ca.DM.zeros(n + equal), ca.fmax(sized[-1], 1.0), VIOLATION_PRICE * ca.DM.ones(rows))
    at: Any = [first, ca.DM.zeros(n), ca.inf]
    for _ in range(steps):
        at = until_done(at[2] > SOLVERS, *at, *sized)
    return ca.Function("interior_point", given, [size * at[1], at[2]], list(shapes), ["z", "residual"])


def _step(shapes: dict[str, Any], n: int, equal: int, rows: int) -> tuple[ca.Function, ca.Function]:
    """What a step solves, with residual and z, and where it leads."""
    H, g, E, e, G, k = data = [ca.MX.sym(name, shape) for name, shape in shapes.items()]
    now, moves = ca.MX.sym("now", n + equal + 2 * rows), ca.MX.sym("moves", n + equal, 2)
    z, costates, room, pushes = ca.vertsplit(now, np.cumsum([0, n, equal, rows, rows]).tolist())
    gradient, gaps, over = H @ z + g + E.T @ costates + G.T @ pushes, E @ z - e, G @ z + room - k
    residual = ca.norm_2(ca.vertcat(gradient, gaps, over, room * pushes))
    curved = H + G.T @ ca.diag(pushes / room) @ G + SOLVERS * ca.MX.eye(n)
    matrix = ca.blockcat([[curved, E.T], [E, -SOLVERS * ca.MX.eye(equal)]])
    # towards the optimum, and towards the centre
    right = ca.blockcat([[-gradient - G.T @ (pushes * over / room - pushes), -G.T @ (1 / room)],
                         [-gaps, ca.MX(equal, 1)]])  # fmt: skip
    stated = ca.Function("stated", [now, *data], [matrix, right, residual, z], {"cse": True})

    rooms = ca.horzcat(-over, ca.MX(rows, 1)) - G @ moves[:n, :]
    pushed = ca.horzcat(-pushes - pushes * rooms[:, 0] / room, (1 - pushes * rooms[:, 1]) / room)

    def longest(of_room: Any, of_pushes: Any) -> Any:
        """Longest step to the nearest bound, 1 at most."""
        return 1 / ca.fmax(1.0, ca.mmax(ca.vertcat(-of_room / room, -of_pushes / pushes)) / (1 - KKT**0.5))

    part = longest(rooms[:, 0], pushed[:, 0])
    product = ca.dot(room, pushes)
    left = ca.dot(room + part * rooms[:, 0], pushes + part * pushed[:, 0])
    weights = ca.vertcat(1.0, product / rows * (left / product) ** 3)
    whole = ca.vertcat(moves, rooms, pushed) @ weights
    part = longest(*ca.vertsplit(whole[n + equal :], rows))
    return stated, ca.Function("moved", [now, *data, moves], [now + part * whole], {"cse": True})
