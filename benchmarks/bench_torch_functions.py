"""`to_torch` beside CasADi's own `map` and a loop of calls: the steps of two cars at 10 000 states, one thread.

Prints medians of nine rounds, the three interleaved; the loop is timed on 1000 of the states. Values, and gradients of
the sum by x, u, w and p, are compared with CasADi's in double precision, relative to the largest of each.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import numpy as np
import torch

from ccdtools.plants import to_torch
from ccdtools.plants.library import full_car, quarter_car

STATES, LOOPED, ROUNDS = 10_000, 1000, 9


def timed(call: Callable[[], object]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def row(name: str, f: ca.Function, scale: np.ndarray, design: np.ndarray) -> str:
    """The figures of one right-hand side f(x, u, w, p)."""
    rng = np.random.default_rng(0)
    sizes = [f.numel_in(i) for i in range(3)]
    columns = [part * rng.standard_normal((STATES, n)) for part, n in zip((scale, 100.0, 0.3), sizes)]
    mapped = f.map(STATES)
    transposed = [ca.DM(column.T) for column in columns]
    designs = ca.repmat(ca.DM(design), 1, STATES)
    translated = to_torch(f)
    tensors = [torch.tensor(column) for column in columns] + [torch.tensor(design)]

    def looped() -> None:
        """One call for each state."""
        for k in range(LOOPED):
            f(*(column[k] for column in columns), design)

    calls = {"to_torch": lambda: translated(*tensors), "map": lambda: mapped(*transposed, designs), "loop": looped}
    times = {what: [] for what in calls}
    for _ in range(ROUNDS):
        for what, call in calls.items():
            times[what].append(timed(call))
    median = {what: float(np.median(found)) for what, found in times.items()}
    median["loop"] *= STATES / LOOPED
    value = np.asarray(mapped(*transposed, designs)).T
    off = np.abs(translated(*tensors).numpy() - value).max() / np.abs(value).max()
    arguments = [ca.SX.sym(n, f.numel_in(i)) for i, n in enumerate("xuwp")]
    total = ca.Function("total", arguments, [ca.gradient(ca.sum1(f(*arguments)), part) for part in arguments])
    exact = [np.asarray(part).T for part in total.map(STATES)(*transposed, designs)]
    leaves = [tensor.clone().requires_grad_(True) for tensor in tensors]
    gradients = torch.autograd.grad(translated(*leaves).sum(), leaves)
    pairs = zip(gradients, [*exact[:3], exact[3].sum(0)])
    wrong = max(np.abs(own.numpy() - other).max() / np.abs(other).max() for own, other in pairs)
    times_text = f"{1e3 * median['to_torch']:.2f} ms | {1e3 * median['map']:.2f} ms | {1e3 * median['loop']:.0f} ms"
    ratio = f"{median['map'] / median['to_torch']:.1f} | {median['loop'] / median['to_torch']:.0f}"
    return f"| {name} | {times_text} | {ratio} | {off:.1e} | {wrong:.1e} |"


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    print("| dynamics | to_torch | map | loop | map / to_torch | loop / to_torch | values off | gradients off |")
    print("|---|---|---|---|---|---|---|---|")
    car = quarter_car(nonlinear=True)
    print(row("quarter car, nonlinear", car.right_hand_side, np.array([0.01, 1, 0.05, 1]), car.design.centre))
    car = full_car(road="height", real=True)
    print(row("full car, 14 states, real", car.right_hand_side, np.full(car.nx, 0.02), car.design.centre))


if __name__ == "__main__":
    main()
