"""Plants on which no expert keeps a run, or of which there is none."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    codesign,
    discretise,
)
from ccdtools.plants import BlackBox

BOX = DesignSpace(["gain"], [1.0], [3.0])
FEW = CoDesignConfig(iterations=4, pathwise_runs=8, evaluation_runs=16)


def escaping(model, U=0.2):
    """Problem whose runs leave whatever is done."""
    return CoDesignProblem(
        model, X=(-1, 1), U=(-U, U), steps=20, limit_tolerance="off", objective=QuadraticObjective([[1.0]], [[0.01]]),
        scenarios=FixedStart([0.5], Gaussian([0.0])),
    )  # fmt: skip


def equations(step):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    return discretise(Plant(x, u, w, p, step(x, u, p) + w, BOX, 0.1, continuous=False))


def simulator(x, u, w, p):
    return 2 * x + 0.1 * u * p


@pytest.mark.check
@pytest.mark.parametrize("model", ["equations", pytest.param("simulator", marks=pytest.mark.check)])
def test_a_plant_that_escapes_every_law_is_told_as_diverging(model):
    if model == "equations":
        model = equations(lambda x, u, p: 2 * x + 0.1 * p * u + 0.001 * x**3)
    else:
        model = BlackBox(simulator, nx=1, nu=1, nw=1, dt=0.1, design=BOX, batched=True)
    found = codesign(escaping(model), method="pathwise", config=FEW, rng=np.random.default_rng(0))
    assert found.status.name == "DIVERGING"


@pytest.mark.check
def test_a_plant_without_a_regulator_is_refused_by_name():
    model = equations(lambda x, u, p: 1.1 * x + 0.1 * p * u * x)
    with pytest.raises(InputError, match=r"none lies in X_fea|cannot be stabilised|samples"):
        codesign(escaping(model, U=2.0), method="pathwise", config=FEW, rng=np.random.default_rng(0))
