"""Illustrative example of Tsai et al., whose input matrix is the design."""

from __future__ import annotations

import casadi as ca

from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant
from ccdtools_ground.door import as_flag


def illustrative(*, real: bool = False) -> Plant:
    """Unstable discrete system of two states.

    Parameters
    ----------
    real : bool
        Whether to return the real system, with a bias, a drift and a gain that varies.

    Returns
    -------
    Plant
        x⁺ = A x + B(p) u + w with p in [0.5, 3]; one step is 1 s. The origin is no equilibrium of the real one.

    References
    ----------
    Tsai, Karkaria, Chen and Chen, "Digital Twin-enabled Multi-generation Control Co-Design with Deep Reinforcement
    Learning", equations numerical_example and real_system_numerical_example.
    """
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    w = ca.SX.sym("w", 2)
    p = ca.SX.sym("p")
    following = ca.DM([[0.8, 0.5], [0.5, 0.6]]) @ x + ca.vertcat(0.5, p) * u + w
    if as_flag("real", real):
        x1, x2 = ca.vertsplit(x)
        drift = ca.vertcat(x1 * ca.sin(x1) + x2 * ca.cos(x2), x2 * ca.sin(x2) + x1 * ca.cos(x1))
        gain = ca.vertcat(ca.sin(x1), p * ca.cos(x2))
        following += ca.DM([0.1, -0.2]) + 0.1 * drift + 0.5 * gain * u
    design = DesignSpace(["p"], lower=[0.5], upper=[3.0])
    return Plant(x, u, w, p, following, design, dt=1.0, continuous=False)
