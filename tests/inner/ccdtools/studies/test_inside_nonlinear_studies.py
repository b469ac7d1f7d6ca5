"""What test_nonlinear_studies.py claims, seen from inside."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, Study
from ccdtools.studies import configuration
from ccdtools.studies.preparation import fingerprint

NOISE = Gaussian([0.1])
X = ([-2.0, -2.0], [2.0, 2.0])


def tank(*, rate=3000.0, cubic=0.2, substeps=10) -> Plant:
    """A tank behind a valve whose servo follows the input at a rate [1/s]; its outlet is the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    level = x[0] + w - p * (x[1] + cubic * x[1] ** 3)
    space = DesignSpace(["k"], [1.0], [4.0])
    return Plant(x, u, w, p, ca.vertcat(-rate * (x[0] - u), level), space, dt=0.05, substeps=substeps)


def study(plant, **changes) -> Study:
    fields = {
        "name": "tank", "title": "A tank", "plant": plant, "disturbance": NOISE, "x0": [0.0, 0.5], "X": X,
        "U": (-1.0, 1.0), "objective": QuadraticObjective(np.eye(2), [[0.1]]), "p0": [2.0], "steps": 100,
    }  # fmt: skip
    return Study(**(fields | changes))


@pytest.mark.check
def test_another_accuracy_is_another_run():
    one = study(tank(rate=30.0))
    config = configuration(one)
    before, now = (fingerprint(own, {}, config) for own in (one, replace(one, accuracy=1e-4, method="rk4")))
    assert {name for name in before if before[name] != now.get(name)} == {"study.accuracy", "study.method"}
    assert fingerprint(study(tank(rate=30.0)), {}, config) == before
