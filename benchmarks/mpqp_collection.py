"""The 100 random mp-QPs of the ParametricDAQP paper: how many are complete in time, and the law against the online QP.

    python benchmarks/mpqp_collection.py [first last [time_limit]]

The problems (`test_set.mat` of github.com/darnstrom/cdc24-mpqp; Arnström and Axehill, IEEE CDC 2024) are not part of
this repository: put the file into ../shared/cdc24-mpqp, or name its folder in the environment variable MPQP_COLLECTION.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

from invariant_sets import Polytope  # noqa: E402
from mpc import ExplicitMPC, MPQPStatus, ParametricQP, solve_mpqp  # noqa: E402
from mpc.dense_qp import DenseQP  # noqa: E402
from mpc.parametric_qp import Constraint  # noqa: E402

STATES = 50  # random parameters at which the law is compared with the online QP


def collection_file():
    """Path of the problems, or None where they are not on this machine."""
    folder = Path(os.environ.get("MPQP_COLLECTION", ROOT.parent / "shared" / "cdc24-mpqp"))
    file = folder / "test_set.mat"
    return file if file.is_file() else None


def read_problems(file):
    """(problem, parameter set) of every entry: min ½z'Qz + (Ht θ + c)'z subject to Az <= b + Fθ, Tmin <= θ <= Tmax."""
    from scipy.io import loadmat

    for entry in loadmat(file, simplify_cells=True)["problem"]:
        m, nz, nt = np.size(entry["b"]), np.size(entry["c"]), np.size(entry["Tmin"])

        def part(name, *shape, entry=entry):
            return np.asarray(entry[name], dtype=float).reshape(shape)

        problem = ParametricQP(
            H=part("Q", nz, nz), F=part("Ht", nz, nt), f=part("c", nz), Y=np.zeros((nt, nt)), y=np.zeros(nt), c=0.0,
            G=part("A", m, nz), w=part("b", m), S=part("F", m, nt), Lz=np.eye(nz), Lt=np.zeros((nz, nt)),
            l=np.zeros(nz), Xz=np.zeros((nt, nz)), Xt=np.eye(nt), x=np.zeros(nt), nu=nz, parameters=(("x", nt),),
            labels=tuple(Constraint("input", 0, i) for i in range(m)),
        )  # fmt: skip
        yield problem, Polytope.from_bounds(part("Tmin", nt), part("Tmax", nt))


def compare_with_online(partition, count=STATES):
    """Largest error of the law relative to the largest |z|, and the share of feasible parameters in no region."""
    problem = partition.problem
    theta = partition.centre + partition.half * np.random.default_rng(0).uniform(-1, 1, size=(count, problem.nt))
    region = np.full(count, -1)
    if len(partition):
        region = ExplicitMPC.from_partition(partition, method="sequential").locate(theta)
    solver = DenseQP(problem.H, problem.G)
    online = [solver.solve(*problem.at(t)) for t in theta]
    feasible = np.array([not result.infeasible for result in online])
    known = feasible & (region >= 0)
    law = partition.law[region[known]]
    z = np.einsum("nij,nj->ni", law[:, :, :-1], theta[known]) + law[:, :, -1]
    truth = np.array([online[i].z for i in np.flatnonzero(known)]).reshape(z.shape)
    size = np.sqrt(np.diag(problem.H))
    error = np.abs((z - truth) * size).max(initial=0.0) / max(np.abs(truth * size).max(initial=0.0), 1e-300)
    return error, np.mean(region[feasible] < 0) if feasible.any() else 0.0


def main(first=1, last=100, time_limit=25.0):
    """Print one row a problem, and the totals."""
    file = collection_file()
    if file is None:
        print("skipped: no test_set.mat in ../shared/cdc24-mpqp nor in the folder that MPQP_COLLECTION names")
        return
    print("| problem | parameters | variables | constraints | status | regions | s | law against online QP | holes |")
    print("|---|---|---|---|---|---|---|---|---|")
    complete, worst, slowest = 0, 0.0, 0.0
    for number, (problem, theta_set) in enumerate(read_problems(file), start=1):
        if not first <= number <= last:
            continue
        start = time.perf_counter()
        partition = solve_mpqp(problem, theta_set, max_regions=10**7, time_limit=time_limit)
        seconds = time.perf_counter() - start
        error, holes = compare_with_online(partition)
        done = partition.status is MPQPStatus.COMPLETE
        complete += done
        worst = max(worst, error)
        slowest = max(slowest, seconds if done else 0.0)
        size = f"{problem.nt} | {problem.nz} | {problem.m} | {partition.status.name} | {len(partition)}"
        print(f"| {number} | {size} | {seconds:.2f} | {error:.1e} | {holes:.3f} |", flush=True)
    print(f"\ncomplete: {complete} of {last - first + 1}, slowest of them {slowest:.1f} s; worst law {worst:.1e}")


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:3]), *(float(a) for a in sys.argv[3:4]))
