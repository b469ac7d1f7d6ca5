"""A plant of a user: a mass on a spring, whose stiffness and damping are the design."""

import casadi as ca

import ccdtools as cc


def hanging_mass(dt=0.1):
    """The plant, in deviations from rest."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    space = cc.DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0], units=["N/m", "N·s/m"])
    return cc.Plant(x, u, w, p, ca.vertcat(x[1], -p[0] * x[0] - p[1] * x[1] + u + w), space, dt=dt)
