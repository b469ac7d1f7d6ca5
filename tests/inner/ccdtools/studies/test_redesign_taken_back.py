"""A redesign on sensors that the real plant does not confirm."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Measurement,
    Nested,
    Passive,
    Plant,
    QuadraticObjective,
    RealPlant,
    discretise,
)
from ccdtools.statistics import PairedDifference
from ccdtools.studies import by_fit, fitted_generations


@pytest.mark.long
def test_what_is_worse_on_the_real_plant_goes_out_of_service(monkeypatch):
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    rates = [x[1], -k * x[0] - 0.3 * x[1] + u + w]
    plant = Plant(x, u, w, k, rates, DesignSpace(["k"], [0.5], [4.0]), dt=0.33)
    problem = CoDesignProblem(
        discretise(plant), X=(-4, 4), U=(-3, 3), steps=50, limit_tolerance="off",
        objective=QuadraticObjective(np.eye(2), [[0.1]]), scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])),
        measurement=Measurement([[1.0, 0.0]], noise=[0.1]),
    )  # fmt: skip
    designed = by_fit.codesign

    def passive_at_last(problem, **options):
        found = designed(problem, **options)
        return found if options["design"] is None else SimpleNamespace(design=found.design, controller=Passive(1))

    monkeypatch.setattr(by_fit, "codesign", passive_at_last)
    monkeypatch.setattr(by_fit.FittedLoop, "_predicted", lambda *_: PairedDifference(1.0, (0.5, 1.5)))
    first, second = fitted_generations(
        problem, RealPlant(plant, Gaussian([0.3]), [1.0, 0.0], 40, 50), method=Nested("lqg", starts=1),
        rng=np.random.default_rng(0), noise="known",
    )  # fmt: skip
    assert second.gain.ci95[1] < 0
    assert not second.accepted
    assert second.controller is first.controller
    np.testing.assert_array_equal(second.design, first.design)
    assert "taken back" in str(second)
