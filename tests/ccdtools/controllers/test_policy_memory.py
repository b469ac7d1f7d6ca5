"""C99 of a policy with a history or a filter is the controller in its loop."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from compiler import needs_compiler
from exported_policies import MEMORY, NOISE, NU, NY, SPACE, B, M, closed_loop, compiled, of_estimate, of_outputs, policy

from ccdtools import DesignSpace, InputError, LinearFeedback, Plant, discretise, load_policy
from ccdtools.controllers import History, Observed
from ccdtools.estimation import CubatureKalmanFilter
from learning import CheckpointError, load, save


def nonlinear_plant():
    """A continuous plant with functions, a choice and a saturation, of one design and one disturbance."""
    x, u, w, p = (ca.SX.sym(name, n) for name, n in zip("xuwp", (3, NU, 1, 1)))
    dynamics = ca.vertcat(
        x[1] + 0.1 * ca.fmin(u[1], 2.5),
        -ca.sin(x[0]) - p * x[1] * ca.fabs(x[1]) + 3 * u[0] + w,
        ca.if_else(x[2] > 0, -2 * x[2], -x[2] * ca.exp(-(x[0] ** 2))) + 2 * u[0] + ca.tanh(4 * u[1]) / ca.sqrt(1 + p),
    )
    outputs = ca.vertcat(ca.sin(x[0]) + 0.05, ca.atan2(x[1], 2) + 0.2 * u[1])
    return Plant(x, u, w, p, dynamics, SPACE, dt=0.1, outputs=outputs, substeps=3)


def of_cubature(kind):
    """A policy of the estimate of a cubature filter, of a plant, its model or a linear one."""
    plant = model = nonlinear_plant()
    if kind == "sampled":
        model = replace(discretise(plant), substeps=2)
    elif kind == "linear":  # with a constant term
        model = discretise(replace(plant, dynamics=plant.p * (B @ plant.u - plant.x + 0.1)))
    estimator = CubatureKalmanFilter(model, plant, design=[0.5], **NOISE)
    return Observed(of_outputs(n=3, size=2.5).controller, estimator)


def driven(law, y, u):
    """Inputs (runs, T, nu) of a controller that is told outputs, and the inputs before."""
    last = np.concatenate([np.zeros_like(u[:, :1]), u[:, :-1]], axis=1)
    law.reset(len(y))
    return np.stack([law(y=y[:, k], u_prev=last[:, k]) for k in range(y.shape[1])], axis=1)


def test_a_history_of_other_outputs_names_them():
    with pytest.raises(InputError, match="y: got 3 outputs beside 2 inputs, expected 4 together"):
        of_outputs()(y=np.zeros(3), u_prev=np.zeros(2))


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-10), ("float", 1e-3)])
@pytest.mark.parametrize("n", [1, 2])
def test_the_c_code_of_a_filter_sees_a_difference_that_is_nearly_known(tmp_path, rng, scalar, tolerance, n):
    x, u, none = ca.SX.sym("x", n), ca.SX.sym("u", NU), ca.SX(0, 1)
    plant = Plant(x, u, none, none, x + 1e-3 * (ca.sin(x) + u[0]), DesignSpace([], [], []), dt=0.1, continuous=False,
                  outputs=[ca.sin(x[-1] - (x[0] if n > 1 else 0.0))])  # fmt: skip
    P0 = [[0.01]] if n == 1 else [[4.0, 4.0], [4.0, 4.0001]]
    estimator = CubatureKalmanFilter(plant, W=np.full(n, 1e-6), V=[1e-4], P0=P0)
    law = Observed(of_outputs(n=n, size=2.5).controller, estimator)
    law.to_c(tmp_path, scalar=scalar)
    y, u = np.float32(0.02 * rng.standard_normal((20, 4, 1))).astype(float), np.zeros((20, 4, NU))
    begins = np.zeros((20, 4, 1))
    begins[:, 0] = 1.0
    sent = np.concatenate([begins, y, u], axis=2).reshape(80, -1)
    found, code = compiled(tmp_path, sent, scalar, driver=MEMORY % "sent + 1 + POLICY_NY")
    assert not code.any()
    np.testing.assert_allclose(found, driven(law, y, u).reshape(80, NU), rtol=0, atol=tolerance)
    assert np.ptp(found[:, 0]) > 10 * tolerance


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 1e-12), ("float", 1e-6)])
@pytest.mark.parametrize("before", ["sent + 1 + POLICY_NY", "u"], ids=["as applied", "its own"])
@pytest.mark.parametrize("kind", ["history", "filter", "steady filter", "plant", "sampled", "linear"])
def test_the_c_code_of_a_policy_of_outputs_is_the_controller_in_a_closed_loop(
    tmp_path, rng, scalar, tolerance, before, kind
):  # fmt: skip
    if kind in ("plant", "sampled", "linear"):
        law, plant = of_cubature(kind), nonlinear_plant()
        if scalar == "float":  # of two of them one rounding of what is measured moves it by 4e-6 and 5e-6
            tolerance = {"plant": 3e-5, "sampled": 1e-5, "linear": 3e-6}[kind]
    else:
        law, plant = of_outputs() if kind == "history" else of_estimate(steady=kind == "steady filter"), None
    first = law
    law.save(tmp_path / "policy.safetensors", origin="a test")
    law = load_policy(tmp_path / "policy.safetensors")
    report = law.to_c(tmp_path, scalar=scalar)
    y, u = closed_loop(law, rng, plant)
    np.testing.assert_allclose(u, driven(first, y, u), rtol=0, atol=1e-12)
    last = np.concatenate([np.zeros((4, 1, NU)), u[:, :-1]], axis=1)
    begins = np.zeros((4, 250, 1))
    begins[:, 0] = 1.0
    sent = np.concatenate([begins, y, last], axis=2).reshape(1000, -1)
    found, code = compiled(tmp_path, sent, scalar, driver=MEMORY % before)
    assert not code.any()
    half = np.array([2.0, 1.5])
    expected = u
    if scalar == "float":  # what was measured is rounded before it is sent
        expected = driven(law, y.astype(np.float32), u.astype(np.float32))
    np.testing.assert_allclose(found / half, expected.reshape(1000, NU) / half, rtol=0, atol=tolerance)
    assert 0.05 < (np.abs(u - [0.0, 1.5]) >= half).mean() < 0.95
    assert report.flash_bytes < 10_000


@needs_compiler
def test_a_history_that_is_not_finite_is_told_until_it_is_over(tmp_path, rng):
    law = of_outputs()
    law.to_c(tmp_path)
    sent = np.hstack([np.eye(12, 1), rng.normal(size=(12, NY + NU))])
    sent[3, 2] = np.nan
    found, code = compiled(tmp_path, sent, "double", driver=MEMORY % "sent + 1 + POLICY_NY")
    assert code.ravel().tolist() == [0] * 3 + [2] * M + [0] * 4
    expected = np.array([law(y=row[1 : 1 + NY], u_prev=row[1 + NY :]) for row in sent])
    np.testing.assert_allclose(found, np.nan_to_num(expected), atol=1e-12)  # zero is within the limits


class Told:
    """An estimator that is told the state."""

    nu, ny = NU, 3

    def start(self, n):
        return None

    predict = update = start


def test_a_policy_behind_a_filter_of_no_expressions_does_not_leave_python(tmp_path):
    known, plant = of_estimate(), nonlinear_plant()
    stiff = CubatureKalmanFilter(discretise(plant, method="collocation"), design=[0.5], **NOISE)
    python = CubatureKalmanFilter(plant, lambda x: x[:, :NY], design=[0.5], **NOISE)
    for law, argument in (
        (Observed(known.controller, stiff), "estimator: got an implicit step.*filter around"),
        (Observed(known.controller, python), "estimator: got outputs by a function in Python.*filter around"),
        (Observed(known.controller, Told()), "estimator.*filter around"),
        (Observed(LinearFeedback(np.ones((2, 3))), known.estimator), "controller"),
        (Observed(policy(), known.estimator), "estimator: got 3 states"),
    ):  # fmt: skip
        for leave in (lambda law=law: law.to_c(tmp_path), lambda law=law: law.save(tmp_path / "p.safetensors")):
            with pytest.raises(InputError, match=argument):
                leave()


@pytest.mark.parametrize("change", [
    lambda known: known.pop("W"), lambda known: known.update(V=[1.0]), lambda known: known["timing"].pop("dt"),
    lambda known: known["expressions"]["instructions"][5].__setitem__(0, "OP_NEW"),
    lambda known: known["expressions"]["instructions"].pop(0),
    lambda known: known["expressions"].update(values=[3]), lambda known: known.update(expressions=None),
])  # fmt: skip
def test_a_file_whose_filter_was_changed_is_refused(tmp_path, change):
    law, path = of_cubature("plant"), tmp_path / "policy.safetensors"
    law.save(path)
    agent, extra = load(path)
    change(extra["filter"])
    save(path, agent, extra)
    with pytest.raises(CheckpointError, match="filter that cannot be read"):
        load_policy(path)


def test_a_history_of_no_learned_policy_does_not_leave_python(tmp_path):
    other = policy()
    for law, argument in (
        (History(LinearFeedback([[1.0, 0.0]]), 1), "controller"), (History(other, 3), "length"),
        (History(other, 2), "length"),
    ):  # fmt: skip
        for call in (law.to_c, law.to_onnx, law.save, lambda _, law=law: law.to_casadi()):
            with pytest.raises(InputError) as caught:
                call(tmp_path / "x")
            assert caught.value.argument == argument


@pytest.mark.parametrize("law", [of_outputs(), of_estimate()], ids=["history", "filter"])
def test_an_expression_of_a_memory_is_the_controller_again(law):
    function = law.to_casadi()
    again = replace(law, controller=lambda seen: np.array(function(seen.T)).T)
    _, u = closed_loop(law, np.random.default_rng(1))
    np.testing.assert_allclose(closed_loop(again, np.random.default_rng(1))[1], u, rtol=0, atol=1e-11)
