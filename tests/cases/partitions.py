"""Explicit laws to look at: where their regions lie, whether they are optimal there, and some that are degenerate."""

import numpy as np
from online_qp import minimiser
from plants import box, double_integrator

from mpc import LinearMPC


def integrator(N, R, **more):
    """MPC of the double integrator in a box, with a weight R and more options."""
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[R]], horizon=N, X=box([5, 5]), U=box([1]), **more)


def stacked_integrators(N):
    """Two plants that do not know of each other: facets of one cut through regions of the other."""
    A, B = double_integrator()
    eye = np.eye(2)
    return LinearMPC(np.kron(eye, A), np.kron(eye, B), Q=np.eye(4), R=0.1 * eye, horizon=N, X=box(5 * np.ones(4)),
                     U=box([1, 1]))  # fmt: skip


def membership(partition, theta):
    """Largest violation of every region's facets, (n, n_regions), in scaled parameters."""
    rows = partition.scaled_rows
    scaled = (theta - partition.centre) / partition.half
    return np.maximum.reduceat(scaled @ rows[:, :-1].T - rows[:, -1], partition.offsets[:-1], axis=1)


def law_is_optimal_on_samples(mpc, partition, count):
    """Compare the law with the online minimiser at random parameters, and its regions with where there is one."""
    problem = partition.problem
    spread = np.random.default_rng(0).uniform(-1, 1, size=(count, problem.nt))
    theta = partition.centre + partition.half * spread
    inside = membership(partition, theta)
    for t, row in zip(theta, inside):
        best = minimiser(problem, t)
        if abs(row.min()) > 1e-6:
            assert (best is None) == (row.min() > 0)
        if best is not None and row.min() <= 1e-7:
            z = partition.law[row.argmin()] @ np.append(t, 1.0)
            np.testing.assert_allclose(z, best, atol=1e-6 * max(1.0, np.abs(best).max()))
