"""The regulator under an adversary: weights over 14 decades, none at all, modes out of reach, large plants.

    python benchmarks/adversarial_regulator.py [--count 2000] [--seed 0]

The oracle is the doubling iteration in 200 decimal digits (mpmath), with a weight of 1e-60 on every state so that it
finds the stabilising solution; beside it stands SciPy. A pair is right where the cost matrix, in units in which its
diagonal is one, agrees with the oracle to 1e-6 and the gain costs 1e-9 more at most; or where it is refused and the
mode named is out of reach (or not seen on the unit circle) by how the pair was made.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import mpmath as mp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.linalg import block_diag, expm, solve_discrete_are  # noqa: E402

from mpc import NotStabilisableError, lqr  # noqa: E402

mp.mp.dps = 200
AGREE = 1e-6  # of the cost
AGREE_GAIN = 3e-5  # of the gain in units of the cost: what it costs more is the square


def oracle(A, B, Q, R):
    """Gain and cost matrix of the stabilising solution, or None where the iteration does not end."""
    F, H, weight = (mp.matrix(np.atleast_2d(M).tolist()) for M in (A, Q, R))
    B = mp.matrix(B.tolist())
    G = B * weight**-1 * B.T
    eye = mp.eye(len(A))
    H = H + eye * mp.mpf(10) ** -60 * (max(abs(v) for v in H) or 1)
    for _ in range(400):
        inverse = (eye + G * H) ** -1
        more = F.T * H * inverse * F
        F, G, H = F * inverse * F, G + F * inverse * G * F.T, H + more
        if all(abs(more[i, i]) <= mp.mpf(10) ** -100 * abs(H[i, i]) for i in range(len(A))):
            K = (weight + B.T * H * B) ** -1 * (B.T * H * mp.matrix(A.tolist()))
            return tuple(np.array(M.tolist(), dtype=float) for M in (K, H))
    return None


def agrees(K, P, exact, Q, R):
    """Whether both agree, in units of the cost; below 1e-40 of the weights nothing is told from zero."""
    K_exact, P_exact = exact
    floor = 1e-40 * max(np.abs(Q).max(), np.abs(R).max())
    size = np.sqrt(np.maximum(np.diag(P_exact), floor))
    effort = np.sqrt(np.diag(R))
    right = np.abs(P - P_exact) <= AGREE * size * size[:, None]
    return right.all() and (np.abs(K - K_exact) * effort[:, None] <= AGREE_GAIN * size).all()


def scipy_agrees(A, B, Q, R, exact):
    """The same of SciPy's solution."""
    try:
        with np.errstate(all="ignore"):
            P = solve_discrete_are(A, B, Q, R)
            return agrees(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), P, exact, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return False


def pair(rng):
    """A plant of up to six states, stable or not, a third of them triangular."""
    n = int(rng.integers(1, 7))
    A = rng.normal(size=(n, n))
    A = np.triu(A) if rng.random() < 0.3 else A
    A *= rng.uniform(0.5, 1.5) / np.abs(np.linalg.eigvals(A)).max()
    return A, rng.normal(size=(n, int(rng.integers(1, min(n, 3) + 1))))


def weights(rng, n, m, kind):
    """Q and R over 14 decades; with zeros, no Q, or no diagonal."""
    q, R = 10.0 ** rng.uniform(-7, 7, n), np.diag(10.0 ** rng.uniform(-7, 7, m))
    if kind == "zeros":
        q[rng.random(n) < 0.5] = 0.0
    if kind == "Q = 0":
        q[:] = 0.0
    if kind != "dense":
        return np.diag(q), R
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    Q = turn * q @ turn.T
    return (Q + Q.T) / 2, R


def judged(A, B, Q, R, modes=()):
    """What the regulator says of a pair whose modes out of reach, or unseen on the unit circle, are known."""
    try:
        K, P = lqr(A, B, Q=Q, R=R)
    except NotStabilisableError as error:
        named = error.eigenvalue is not None and any(abs(error.eigenvalue - mode) < 1e-4 for mode in modes)
        return "rightly refused" if named else "WRONGLY NAMED" if modes else "WRONGLY REFUSED"
    if modes:
        return "WRONGLY ACCEPTED"
    exact = oracle(A, B, Q, R)
    if exact is None:
        return "the oracle does not end"
    by_scipy = scipy_agrees(A, B, Q, R, exact)
    return ("right" if agrees(K, P, exact, Q, R) else "WRONG") + ("" if by_scipy else ", SciPy wrong")


def out_of_reach(rng):
    """A pair with modes that no input reaches, up to two of them outside the unit circle, in turned coordinates."""
    A, B = pair(rng)
    lost = rng.choice([0.3, 0.9, 0.99, 1.0, 1.0069, 1.05, 1.3], size=int(rng.integers(1, 4)), replace=False)
    coupling = rng.normal(size=(len(A), len(lost)))
    A = np.block([[A, coupling], [np.zeros(coupling.T.shape), np.diag(lost)]])
    B = np.vstack([B, np.zeros((len(lost), B.shape[1]))])
    turn = np.linalg.qr(rng.normal(size=A.shape))[0] * 10.0 ** rng.uniform(-2, 2, len(A))
    return turn @ A @ np.linalg.inv(turn), turn @ B, [float(v) for v in lost if v >= 1]


def unseen(rng):
    """A pair with a mode on the unit circle that Q does not see: exactly, or turned and but for rounding."""
    A, B = pair(rng)
    n = len(A)
    A = np.block([[A, np.zeros((n, 1))], [rng.normal(size=(1, n)), np.ones((1, 1))]])
    B = np.vstack([B, rng.normal(size=(1, B.shape[1]))])
    if rng.random() < 0.5:
        unit = 2.0 ** rng.integers(-20, 20, n + 1)
        Q = np.diag(np.append(10.0 ** rng.uniform(-7, 7, n), 0.0))
        return A * unit[:, None] / unit, B * unit[:, None], Q
    turn = np.linalg.qr(rng.normal(size=A.shape))[0]
    left = turn[:, :-1]
    return turn @ A @ turn.T, turn @ B, left * rng.uniform(0.1, 1, n) @ left.T


def pole_on_a_cart(dt=0.02):
    """Position, speed, angle and rate; a force."""
    return sampled([[0, 1, 0, 0], [0, 0, -0.981, 0], [0, 0, 0, 1], [0, 0, 21.582, 0]], [[0], [1], [0], [-2]], dt)


def aircraft(dt=0.05):
    """The aircraft of Hung and MacFarlane (1982), AC1 of COMPleib."""
    A = [[0, 0, 1.132, 0, -1], [0, -0.0538, -0.1712, 0, 0.0705], [0, 0, 0, 1, 0], [0, 0.0485, 0, -0.8556, -1.013],
         [0, -0.2909, 0, 1.0532, -0.6859]]  # fmt: skip
    return sampled(A, [[0, 0, 0], [-0.12, 1, 0], [0, 0, 0], [4.419, 0, -1.665], [1.575, 0, -0.0732]], dt)


def helicopter(dt=0.05):
    """The helicopter of Keel, Bhattacharyya and Howze (1988), HE1 of COMPleib."""
    A = [[-0.0366, 0.0271, 0.0188, -0.4555], [0.0482, -1.01, 0.0024, -4.0208], [0.1002, 0.3681, -0.707, 1.42],
         [0, 0, 1, 0]]  # fmt: skip
    return sampled(A, [[0.4422, 0.1761], [3.5446, -7.5922], [-5.52, 4.49], [0, 0]], dt)


def floating_body(rng, n):
    """A rotor, a platform and flexible modes, hydrodynamic memory, in SI units: structure and sizes of a turbine."""
    modes = n // 2 - 2
    slow = 2 * np.pi * 10.0 ** rng.uniform(-2, 0.6, modes)
    blocks = [np.array([[0, 1], [-w * w, -2 * rng.uniform(0.002, 0.05) * w]]) for w in slow]
    A = block_diag(*blocks, [[0.0, 1.0], [0.0, -0.02]], [[-0.3]], [[-1.0]])
    B = np.zeros((len(A), 2))
    speeds = np.arange(1, 2 * modes, 2)
    B[speeds] = 1e-7 * rng.normal(size=(modes, 2))  # force and torque on masses of thousands of tons
    A[speeds, -2] = 1e-3 * rng.normal(size=modes)  # of actuator states
    A[2 * modes + 1, speeds] = 1e-2 * rng.normal(size=modes)
    A[speeds, 2 * modes + 1] = 1e-3 * rng.normal(size=modes)
    B[-2:] = [[0.3, 0], [0, 1.0]]
    B[2 * modes + 1] = [1e-3, -1e-8]
    return sampled(A, B, 0.1)


def sampled(A, B, dt):
    """A and B under a held input."""
    A, B = np.array(A, dtype=float), np.array(B, dtype=float)
    n, m = B.shape
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
    return both[:n, :n], both[:n, n:]


def large(rng, count):
    """Floating bodies of 70 to 104 states with weighted outputs and 1e-8 on every state: residual and radius tell."""
    found = Counter()
    for n in np.linspace(70, 104, count).astype(int):
        A, B = floating_body(rng, int(n))
        C = rng.normal(size=(4, len(A))) * 10.0 ** rng.uniform(-2, 4, (4, 1))
        Q = C.T @ C + 1e-8 * np.eye(len(A))
        R = np.diag(10.0 ** rng.uniform(-4, 2, 2))
        try:
            K, P = lqr(A, B, Q=Q, R=R)
        except NotStabilisableError:
            found["WRONGLY REFUSED"] += 1
            continue
        size = np.sqrt(np.diag(P))
        missed = (A.T @ P @ (A - B @ K) + Q - P) / size / size[:, None]
        radius = np.abs(np.linalg.eigvals(A - B @ K)).max()
        found["right" if np.abs(missed).max() < 1e-8 and radius < 1 else "WRONG"] += 1
    return found


def rows(count, seed):
    """Name and counted verdicts of every row."""
    for kind in ("plain", "zeros", "Q = 0", "dense"):
        rng = np.random.default_rng([seed, len(kind)])
        found = Counter()
        for _ in range(count):
            A, B = pair(rng)
            found[judged(A, B, *weights(rng, *B.shape, kind))] += 1
        yield f"weights over 14 decades, {kind}", found
    rng = np.random.default_rng([seed, 1])
    found = Counter()
    for _ in range(count):
        A, B, modes = out_of_reach(rng)
        found[judged(A, B, *weights(rng, *B.shape, "plain"), modes)] += 1
    yield "modes out of reach", found
    found = Counter()
    for _ in range(count):
        A, B, Q = unseen(rng)
        found[judged(A, B, Q, np.eye(B.shape[1]), [1.0])] += 1
    yield "a mode on the unit circle without a weight", found
    found = Counter()
    for _ in range(max(1, count // 20)):
        for plant in (pole_on_a_cart, aircraft, helicopter):
            A, B = plant(10.0 ** rng.uniform(-2.5, 0))
            found[judged(A, B, *weights(rng, *B.shape, str(rng.choice(["plain", "dense"]))))] += 1
    yield "pole on a cart, AC1, HE1, weights over 14 decades", found
    yield "floating bodies of 70 to 104 states", large(rng, max(1, count // 50))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=2000, help="pairs of all the rows with random weights together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| pairs | verdicts |\n|---|---|")
    for name, found in rows(max(1, options.count // 4), options.seed):
        print(f"| {name} | {', '.join(f'{n} {what}' for what, n in found.most_common())} |", flush=True)


if __name__ == "__main__":
    main()
