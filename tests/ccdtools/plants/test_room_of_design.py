"""A plant that is singular outside the room that a design leaves is integrated to its accuracy within that room."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc


def gap_plant() -> cc.Plant:
    """Pulled towards two poles at ± gap, where the pull is infinite."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("gap")
    pull = p**2 * (1 / (p - x[0]) - 1 / (p + x[0])) / 2
    space = cc.DesignSpace(["gap"], [0.2], [1.0])
    return cc.Plant(x, u, w, p, ca.vertcat(x[1], pull - 4 * x[0] - x[1] + u + w), space, dt=0.05)


def study(X) -> cc.Study:
    """Regulation of that plant."""
    return cc.Study(
        name="gap", title="A pull across a gap", plant=gap_plant(), X=X, U=([-0.1], [0.1]), x0=[0.02, 0.0], p0=[0.5],
        objective=cc.QuadraticObjective(np.eye(2), [[0.1]]), disturbance=cc.Gaussian([0.01]), steps=20,
    )  # fmt: skip


def test_accuracy_is_asked_for_in_the_room_that_each_design_has():
    own = study(lambda p: (-0.5 * p[0] * np.ones(2), 0.5 * p[0] * np.ones(2)))
    assert own.model.substeps <= 16
    assert own.model.error.relative <= own.accuracy
    gap, x = own.model.error.p[0], own.model.error.x
    assert np.abs(x).max() <= 0.5 * gap + 1e-12
    again = cc.discretise(own.plant, X=own.X, U=own.U, W=([-0.05], [0.05]))
    assert again.substeps <= 16


def test_a_function_of_the_design_and_the_limits_of_a_study_are_the_same_room():
    own = study(lambda p: (-0.5 * p[0], 0.5 * p[0]))
    limits = {"U": lambda p: (-0.1, 0.1), "W": ([-0.05], [0.05])}
    given = cc.discretise(own.plant, X=lambda p: (-0.5 * p[0], 0.5 * p[0]), **limits)
    again = cc.discretise(own.plant, X=own.X, **limits)
    assert given.substeps == again.substeps
    assert given.error.relative == pytest.approx(again.error.relative)


@pytest.mark.check
def test_the_same_room_for_all_designs_holds_the_singular_points():
    with pytest.raises(cc.InputError, match="accuracy"):
        study(([-0.5, -0.5], [0.5, 0.5]))
