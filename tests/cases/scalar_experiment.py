"""Two laws of a scalar plant that experiments compare: one is given, one is learned by chance."""

import numpy as np

from ccdtools import InputError, LinearFeedback, QuadraticObjective, Scenario, experiment, plant_from_matrices
from ccdtools.plants import BlackBox

A, R = 0.9, 0.5
PLANT = plant_from_matrices([[A]], [[1.0]], [[1.0]], dt=1.0, continuous=False)
OBJECTIVE = QuadraticObjective(Q=[[1.0]], R=[[R]])
GAIN = 0.55
LAWS = {
    "LQR": lambda design, rng: LinearFeedback([[GAIN]]),
    "learned": lambda design, rng: (LinearFeedback([[GAIN + 0.1 * rng.random()]]), 500),
}
WEAK = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.3]])}
WILD = Scenario(PLANT, [[0.1], [5.0]], np.zeros((2, 15, 1)))


def never(design, rng):
    """A controller that cannot be made."""
    raise InputError("gains", "none", "some")


def always(laws):
    """Functions that make these controllers, whatever the seed."""
    return {name: lambda design, rng, law=law: law for name, law in laws.items()}


def drawn(rng):
    return Scenario(PLANT, 2 * rng.standard_normal((7, 1)), rng.standard_normal((7, 15, 1)))


def stopping(beyond):
    """The plant as a simulator that stops beyond some |x|."""

    def advance(x, u, w, p):
        if np.abs(x[0]) > beyond:
            raise OSError("the solver failed")
        return A * x + u + w

    return BlackBox(advance, nx=1, nu=1, nw=1, dt=1.0)


def found(laws=LAWS, scenarios=drawn, **options):
    given = {"objective": OBJECTIVE, "X": ([-50.0], [50.0]), "seeds": 4} | options
    return experiment(laws, scenarios, **given)


def by_hand(gain, x0, w):
    """Returns of u = −gain x, written out."""
    x, total = x0[:, 0].copy(), np.zeros(len(x0))
    for k in range(w.shape[1]):
        u = -gain * x
        x = A * x + u + w[:, k, 0]
        total -= x**2 + R * u**2
    return total
