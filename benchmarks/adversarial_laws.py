"""Explicit laws under an adversary: rates of plans at their corners, and files of which one byte was changed.

    python benchmarks/adversarial_laws.py [--count 5000] [--edits 10000] [--seed 0]

Laws of random plants of two and three states with rate, soft and terminal limits. A corner is a vertex of a region, or
a point on one of its facets; a side is the direction to the centre of the region, or one drawn at random that leads
into a region that holds the corner, or out of a complete law. A rate is right where it is the gain of that region in
this direction to 1e-4 of the largest gain; where the status is DEPENDENT, or the way leads out, it is NaN.

A file of which one byte was changed must be refused in an InputError, or be read as what it was.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402
from scipy.spatial import HalfspaceIntersection, QhullError  # noqa: E402

from invariant_sets import Polytope  # noqa: E402
from mpc import ExplicitMPC, InfeasibleError, InputError, LinearMPC, MPQPStatus, NotStabilisableError  # noqa: E402

ACCEPTED = 1e-4
MEETS = 1e-8  # of a facet, scaled parameters
CLEAR = 1e-6
KINDS = ("rate", "soft", "terminal", "rate and soft", "soft and terminal")


def controller(rng, kind):
    """A controller of a random plant."""
    n = int(rng.integers(2, 4)) if "rate" not in kind else 2
    A = rng.normal(size=(n, n))
    m = int(rng.integers(1, 3))
    A *= rng.uniform(0.7, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    options = {"rate_limit": rng.uniform(0.2, 1.0)} if "rate" in kind else {}
    if "soft" in kind:
        options["soft"] = (float(rng.choice([0.0, 5.0, 100.0])), 10.0 ** rng.uniform(0, 3))
    if "terminal" in kind:
        options["terminal_set"] = (-rng.uniform(0.3, 1.5, n), rng.uniform(0.3, 1.5, n))
    return LinearMPC(A, rng.normal(size=(n, m)), Q=np.eye(n), R=0.1, horizon=int(rng.integers(2, 5)),
                     X=(-rng.uniform(1, 3, n), rng.uniform(1, 3, n)), U=(-1, 1), **options)  # fmt: skip


def corners(rng, law, most):
    """Corners and facet points of random regions, with the centre of the region, in scaled parameters."""
    p = law.partition
    for r in rng.permutation(len(p))[:most]:
        rows = p.scaled_rows[p.offsets[r] : p.offsets[r + 1]]
        centre = inner_point(rows)
        if centre is None:
            continue
        try:
            found = HalfspaceIntersection(np.hstack([rows[:, :-1], -rows[:, -1:]]), centre)
        except QhullError:
            continue
        vertices = found.intersections[np.isfinite(found.intersections).all(axis=1)]
        for corner in vertices[rng.permutation(len(vertices))[:2]]:
            yield corner, centre
        row = rows[rng.integers(len(rows))]
        foot = centre + (row[-1] - row[:-1] @ centre) * row[:-1]
        if (rows[:, :-1] @ foot <= rows[:, -1] + 1e-12).all():
            yield foot, centre


def inner_point(rows):
    """The centre of the largest ball in {a't <= b}; None of a ball that is hardly there."""
    from scipy.optimize import linprog

    n = rows.shape[1] - 1
    found = linprog(np.append(np.zeros(n), -1.0), np.hstack([rows[:, :-1], np.ones((len(rows), 1))]), rows[:, -1],
                    bounds=[(None, None)] * n + [(0, 1)])  # fmt: skip
    return found.x[:n] if found.status == 0 and found.x[n] > 1e-3 else None


def entered(law, corner, direction):
    """The region at the corner that a direction leads into; -1 of none, None where that is not clear."""
    p = law.partition
    above = p.scaled_rows[:, :-1] @ corner - p.scaled_rows[:, -1]
    climb = np.where(np.abs(above) < MEETS, p.scaled_rows[:, :-1] @ direction, np.where(above > 0, np.inf, -np.inf))
    worst = np.maximum.reduceat(climb, p.offsets[:-1])
    if (worst < -CLEAR).any():
        return int(np.argmin(worst))
    clear = (worst > CLEAR).all() and law.status is MPQPStatus.COMPLETE and (np.abs(corner) < 1 - CLEAR).all()
    return -1 if clear else None


def verdict(mpc, law, corner, direction):
    """What the rate of the first input is called; None where the side is not clear."""
    p = law.partition
    region = entered(law, corner, direction)
    if region is None:
        return None
    theta, step = p.centre + p.half * corner, p.half * direction
    gain = law.law[region][:, :-1]
    x, u_prev = np.split(theta, [mpc.nx])
    dx, du_prev = np.split(step, [mpc.nx])
    given = {"u_prev": u_prev} if len(u_prev) else {}
    found = mpc.sensitivity(x, **given)
    rate = found.along(dx, du_prev=du_prev if len(u_prev) else None).inputs[0]
    if np.isnan(rate).any():
        return f"{found.status.name}, NaN"
    if region < 0:
        return "leads out, NOT NaN"
    largest = np.abs(law.law[:, :, :-1] * p.half).max()  # a gain that is rounding beside it is none
    size = max(np.abs(gain * p.half).max(), 1e-6 * largest) * np.abs(direction).max() + 1e-9
    error = np.abs(rate - gain @ step).max() / size
    return "right" if error <= ACCEPTED else f"WRONG, {found.status.name}"


def rows(count, seed, kinds=KINDS):
    """Name and counted verdicts of every kind."""
    for kind in kinds:
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        found = Counter()
        while sum(found.values()) < count:
            try:
                mpc = controller(rng, kind)
                extent = np.concatenate([mpc.state_extent, np.ones(mpc.nu * ("rate" in kind))])
                law = mpc.explicit(Polytope.from_bounds(-2 * extent, 2 * extent), max_regions=400)
            except (NotStabilisableError, InfeasibleError):
                continue
            for corner, centre in corners(rng, law, 20):
                drawn = rng.normal(size=len(corner))
                for direction in (centre - corner, drawn / np.linalg.norm(drawn)):
                    said = verdict(mpc, law, corner, direction)
                    found.update([] if said is None else [said])
        yield kind, found


def contents(law):
    """All that a law is, as text."""
    p = law.partition
    arrays = [getattr(p.problem, name) for name in "HFfYyGwSl"] + [p.H, p.h, p.law, law.law, law.tree.planes]
    return str([p.status, p.solve_time, p.uncovered, p.problem.c, p.problem.nu, p.problem.parameters, p.problem.labels,
                law.tree.status, *(array.tobytes() for array in arrays)])  # fmt: skip


def edited(law, count, rng):
    """What becomes of files of a law of which one byte was changed."""
    found = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for file in law.save(Path(folder) / "law"):
            content = file.read_bytes()
            for _ in range(count // 2):
                damaged = bytearray(content)
                place = int(rng.integers(len(content)))
                damaged[place] = (damaged[place] + int(rng.integers(1, 256))) % 256
                file.write_bytes(damaged)
                try:
                    same = contents(ExplicitMPC.load(Path(folder) / "law")) == contents(law)
                    found["read as it was" if same else "READ WITH ANOTHER CONTENT"] += 1
                except InputError:
                    found["refused"] += 1
            file.write_bytes(content)
    return found


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--edits", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| limits | corners | verdicts |\n|---|---|---|")
    for kind, found in rows(max(1, options.count // len(KINDS)), options.seed):
        said = ", ".join(f"{n} {what}" for what, n in found.most_common())
        print(f"| {kind} | {sum(found.values())} | {said} |", flush=True)
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    law = LinearMPC(A, B, Q=1.0, R=0.1, horizon=4, X=(-5, 5), U=(-1, 1)).explicit()
    found = edited(law, options.edits, np.random.default_rng(options.seed))
    print(f"| one byte of a stored law | {options.edits} | {', '.join(f'{n} {what}' for what, n in found.items())} |")


if __name__ == "__main__":
    main()
