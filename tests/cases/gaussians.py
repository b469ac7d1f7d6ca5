"""What a Kalman filter computes, from the joint distribution of all states and outputs: no recursion of covariances."""

import numpy as np


def conditioned(A, B, C, D, W, V, x0, P0, y, u):
    """E and cov of x_k given y_0 … y_k, for all k: y (T, ny), u (T, nu), y_k = C x_k + D u_{k-1} + v_k."""
    T, n = len(y), len(A)
    mean = np.zeros((T, n))
    mean[0] = x0
    for k in range(1, T):
        mean[k] = A @ mean[k - 1] + B @ u[k - 1]
    sources = np.zeros((T * n, T * n))  # how x_k depends on x_0 and the noise of each sample
    for k in range(T):
        for j in range(k + 1):
            sources[k * n : (k + 1) * n, j * n : (j + 1) * n] = np.linalg.matrix_power(A, k - j)
    noise = np.zeros((T * n, T * n))
    noise[:n, :n] = P0
    for j in range(1, T):
        noise[j * n : (j + 1) * n, j * n : (j + 1) * n] = W
    X = sources @ noise @ sources.T
    H = np.kron(np.eye(T), C)
    before = np.vstack([np.zeros_like(u[:1]), u[:-1]])
    rest = (y - mean @ C.T - before @ D.T).ravel()
    means, covariances = [], []
    for k in range(T):
        rows = slice(0, (k + 1) * len(C))
        own = slice(k * n, (k + 1) * n)
        S = (H @ X @ H.T)[rows, rows] + np.kron(np.eye(k + 1), V)
        cross = (X @ H.T)[own, rows]
        means.append(mean[k] + cross @ np.linalg.solve(S, rest[rows]))
        covariances.append(X[own, own] - cross @ np.linalg.solve(S, cross.T))
    return np.array(means), np.array(covariances)


def random_system(rng, n=4, nu=2, ny=2, radius=1.05):
    """A, B, C, W, V of random entries, W of rank n − 1."""
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    G = rng.standard_normal((n, n - 1))
    v = rng.standard_normal((ny, ny))
    return A, rng.standard_normal((n, nu)), rng.standard_normal((ny, n)), G @ G.T, v @ v.T + np.eye(ny)
