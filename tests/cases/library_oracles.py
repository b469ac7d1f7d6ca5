"""What the tests of the library's plants share: numbers out of a plant, and oracles that know no plant."""

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh


def matrices(plant, p):
    """∂f/∂x, ∂f/∂u and ∂f/∂w at zero, for the design p."""
    z = ca.vertcat(plant.x, plant.u, plant.w)
    M = ca.Function("M", [z, plant.p], [ca.densify(ca.jacobian(plant.dynamics, z))])(np.zeros(z.shape), p)
    return np.split(np.asarray(M), [plant.nx, plant.nx + plant.nu], axis=1)


def rates(plant, p, x, u=None, w=None):
    """dx/dt as an array (nx,)."""
    u = np.zeros(plant.nu) if u is None else u
    w = np.zeros(plant.nw) if w is None else w
    return np.asarray(plant.right_hand_side(x, u, w, p)).ravel()


def motion(plant, p, x0, times, w=None):
    """States (nx, times) of the plant without input, integrated to 1e-11; `w` is a function of time."""
    shaking = (lambda t: np.zeros(plant.nw)) if w is None else w
    solution = solve_ivp(
        lambda t, x: rates(plant, p, x, w=shaking(t)), (0, times[-1]), x0, method="DOP853", t_eval=times, rtol=1e-11,
        atol=1e-13,
    )  # fmt: skip
    return solution.y


def frequencies(M, K):
    """Undamped natural frequencies [rad/s] of masses M and stiffnesses K, ascending."""
    return np.sqrt(eigh(K, M, eigvals_only=True))


def oscillations(A, n):
    """The n highest angular frequencies [rad/s] among the eigenvalues of A, ascending."""
    imaginary = np.linalg.eigvals(A).imag
    return np.sort(imaginary[imaginary > 0])[-n:]


def springs(*terms):
    """Stiffness matrix of springs, each a pair of its stiffness and its stretch per coordinate."""
    return sum(k * np.outer(a, a) for k, a in terms)
