"""An error logged at one design is met at another through the disturbance matrix of that other design."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    simulate,
)
from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.plants import LinearModel
from ccdtools.twin import replay_problem, updated_problem
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.residuals import residuals
from ccdtools.twin.transport import ErrorSplit, Transport, check_disturbance_enters, full_rank
from invariant_sets import Polytope
from learning import QuantileConfig
from learning.quantile import QuantileNetwork

LIGHT, HEAVY = np.array([0.5]), np.array([2.0])


def mass(*, units=1.0, channels=1) -> Plant:
    """A mass on a spring, the mass as design, its position in 1/units metres; a second channel pushes the position."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", channels), ca.SX.sym("p")
    force = -1.5 * x[0] / units - 0.4 * x[1] + u + w[0]
    push = w[1] if channels == 2 else 0
    dynamics = ca.vertcat(units * (x[1] + push), force / p)
    return Plant(x, u, w, p, dynamics, DesignSpace(["m"], [0.3], [3.0], ["kg"]), dt=0.1)


def problem(plant) -> CoDesignProblem:
    """Regulation of the mass."""
    X = Polytope.from_bounds([-4.0, -4.0], [4.0, 4.0])
    start = FixedStart([1.0, 0.0], Gaussian(0.5 * np.ones(plant.nw)))
    objective = QuadraticObjective(np.eye(2), [[0.1]])
    return CoDesignProblem(discretise(plant), X, Polytope.from_bounds([-5.0], [5.0]), objective, start, steps=30)


@pytest.fixture(scope="module")
def plant() -> Plant:
    """The mass with one disturbance, a force."""
    return mass()


def logged(plant, p, *, runs=20, steps=60, seed=0):
    """A log of the plant at a design under random forces."""
    w = 0.5 * np.random.default_rng(seed).standard_normal((runs, steps, plant.nw))
    law = LinearFeedback(np.array([[1.0, 1.0]]))
    return simulate(plant, law, x0=np.tile([1.0, 0.0], (runs, 1)), steps=steps, disturbance=w, design=p)


def test_a_replay_at_another_design_is_the_plant_at_that_design_where_it_equals_the_model(plant):
    light, heavy = logged(plant, LIGHT), logged(plant, HEAVY)
    replayed = replay_problem(problem(plant), [residuals(discretise(plant), light)], 60)
    x0, w = replayed.scenarios.whole()
    again = simulate(
        replayed.model, LinearFeedback(np.array([[1.0, 1.0]])), x0=x0, steps=60, disturbance=w, design=HEAVY
    )
    np.testing.assert_allclose(again.states, heavy.states, atol=1e-7)
    assert ErrorSplit(discretise(plant), np.ones(2)).share_of_the_rest([residuals(discretise(plant), light)]) < 1e-12


def test_split_and_matrix_agree_and_are_the_identity_at_the_design_of_the_log(plant):
    model = discretise(plant)
    e = np.random.default_rng(0).standard_normal((7, 2))
    transport = Transport.at(model, LIGHT, [1.0, 2.0])
    w, rest = transport.split(e)
    E = model.matrices(HEAVY)[2]
    np.testing.assert_allclose(e @ transport.matrix(E).T, w @ E.T + rest, atol=1e-12)
    np.testing.assert_array_equal(transport.matrix(model.matrices(LIGHT)[2]), np.eye(2))


def test_the_split_does_not_depend_on_units():
    e = np.random.default_rng(0).standard_normal((9, 2))
    split = []
    for units in (1.0, 1000.0):
        scale = np.array([2.0 * units, 3.0])
        w, rest = Transport.at(discretise(mass(units=units)), LIGHT, scale).split(e * [units, 1.0])
        split.append((w, rest / [units, 1.0]))
    np.testing.assert_allclose(split[0][0], split[1][0], rtol=1e-9)
    np.testing.assert_allclose(split[0][1], split[1][1], rtol=1e-9, atol=1e-12)


def test_the_rest_is_measured_in_scaled_states(plant):
    """A bias of the velocity alone is no force held over a sample: most of it enters, and the share says how much."""
    model = discretise(plant)
    log = residuals(model, logged(plant, LIGHT))
    E = model.matrices(LIGHT)[2][:, 0]
    across = np.array([E[1], -E[0]])
    mixed = replace(log, e_next=np.zeros_like(log.e_next) + 3 * E + 2 * across)
    assert ErrorSplit(model, [1.0, 1.0]).share_of_the_rest([mixed]) == pytest.approx(4 / 13)


def test_two_channels_that_span_the_states_leave_no_rest():
    model = discretise(mass(channels=2))
    e = np.random.default_rng(0).standard_normal((9, 2))
    np.testing.assert_allclose(Transport.at(model, LIGHT, [1.0, 1.0]).split(e)[1], 0.0, atol=1e-12)
    assert full_rank(model, LIGHT, np.ones(2))


def test_the_learned_error_is_carried_and_differentiable_in_the_design(plant):
    model = discretise(plant)
    twin = DigitalTwin(model, scale=[4.0, 4.0]).update(
        logged(plant, LIGHT), weight=np.eye(2), rng=np.random.default_rng(0),
        config=QuantileConfig(steps=20, hidden=(6,)),
    )  # fmt: skip
    updated = updated_problem(problem(plant), twin)
    x, w = torch.tensor([[0.3, -0.2]]), torch.tensor([[0.02, 0.4]])
    u = torch.tensor([[0.1]])

    def following(p):
        return Stepper.at(updated, p)(x, torch.zeros(1, 2), u, w)[0].sum()

    p = torch.tensor([1.7], requires_grad=True)
    following(p).backward()
    with torch.no_grad():
        ahead, behind = (following(torch.tensor([1.7 + h])).double() for h in (0.02, -0.02))
    assert p.grad.item() == pytest.approx(((ahead - behind) / 0.04).item(), rel=0.02)
    stepper = TwinPlant(model, updated.discrepancy).stepper(np.array([1.7]), batch=1)
    torch_step = Stepper.at(updated, torch.tensor([1.7]))(x, torch.zeros(1, 2), u, w)[0]
    np.testing.assert_allclose(stepper(x.numpy(), u.numpy(), w.numpy()), torch_step.detach(), rtol=1e-5)


def test_logs_of_two_designs_teach_one_error_in_the_coordinates_of_the_newer(plant):
    model = discretise(plant)
    twin = DigitalTwin(model, scale=[4.0, 4.0]).remembering(logged(plant, LIGHT)).remembering(logged(plant, HEAVY))
    first, second = twin.carried()
    np.testing.assert_array_equal(second.e_next, twin.logs[1].e_next)
    np.testing.assert_allclose(first.e_next, second.e_next, atol=1e-9)  # the same forces drove both
    assert not np.allclose(twin.logs[0].e_next, second.e_next, atol=1e-3)


def test_a_disturbance_that_enters_nowhere_is_refused_by_name(plant):
    model = replace(discretise(plant), E=ca.SX.zeros(2, 1))
    with pytest.raises(InputError, match=r"plant: got an E\(p\) of rank zero.*Let w act"):
        check_disturbance_enters(model)
    check_disturbance_enters(discretise(plant))
    assert not full_rank(model, LIGHT, np.ones(2))
    np.testing.assert_array_equal(Transport.at(model, LIGHT, [1.0, 1.0]).split(np.ones((1, 2)))[1], np.ones((1, 2)))


def test_dependent_channels_are_not_of_full_rank():
    model = discretise(mass(channels=2))
    twice = replace(model, E=ca.horzcat(model.E[:, 0], 1e-4 * model.E[:, 0]))
    assert not full_rank(twice, LIGHT, np.ones(2))
    e = np.random.default_rng(0).standard_normal((5, 2))
    w, rest = Transport.at(twice, LIGHT, [1.0, 1.0]).split(e)
    assert np.isfinite(w).all()
    np.testing.assert_allclose(w @ twice.matrices(LIGHT)[2].T + rest, e, atol=1e-12)


def test_a_log_of_a_design_outside_the_box_is_refused_by_name(plant):
    log = replace(logged(plant, LIGHT), design=np.array([9.0]))
    with pytest.raises(InputError, match=r"log.design: got m = 9, expected a value in \[0.3, 3\] kg"):
        residuals(discretise(plant), log)


@pytest.mark.parametrize("scale", [[1.0], [1.0, 0.0], [1.0, np.nan], "wide"])
def test_a_scale_must_be_positive(plant, scale):
    with pytest.raises(InputError, match="scale"):
        Transport.at(discretise(plant), LIGHT, scale)


def test_a_model_and_a_discrepancy_of_another_kind_are_refused(plant):
    with pytest.raises(InputError, match="model"):
        ErrorSplit(plant, [1.0, 1.0])
    with pytest.raises(InputError, match="transport"):
        Discrepancy(QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (6,)), np.eye(2), transport=np.eye(2))
    assert isinstance(ErrorSplit(discretise(plant), [1.0, 1.0]).replayed_model, LinearModel)
