"""Plants whose right-hand side jumps: never called linear, and what is lost is said."""

import warnings

import casadi as ca
import numpy as np
import pytest

from ccdtools import DesignSpace, InputError, Plant, discretise, linearise, simulate
from ccdtools.exceptions import JumpWarning
from ccdtools.plants import first_order_hold, noise_covariance

LIMITS = {"X": ([-1, -2], [1, 2]), "U": (-3, 3)}
JUMPS = {
    "friction": lambda x, u, p: -1.5 * ca.sign(x[1]),
    "stop": lambda x, u, p: ca.if_else(x[0] > 0.5, -10.0, 0.0),
    "relay": lambda x, u, p: ca.if_else(x[1] > 0, -1.5, 1.5),
    "both": lambda x, u, p: ca.if_else(ca.logic_and(x[0] > 0, x[1] > 0), 1.0, 0.0),
    "sawtooth": lambda x, u, p: ca.fmod(x[0], 0.3),
    "remainder": lambda x, u, p: ca.remainder(x[0], 0.3),
    "copied sign": lambda x, u, p: ca.copysign(x[0], x[1]),
}
QUANTISED = lambda x, u, p: ca.floor(4 * u) / 4 - u  # noqa: E731
CONTINUOUS = {
    "drag": lambda x, u, p: -ca.sign(x[1]) * x[1] ** 2,
    "outflow": lambda x, u, p: -ca.sign(x[1]) * ca.sqrt(ca.fabs(x[1])),
    "spring beyond a gap": lambda x, u, p: ca.if_else(x[0] > 0.5, -10.0 * (x[0] - 0.5), 0.0),
}


def mass(force, **options):
    """A mass of which p decides, on a spring, with another force."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], (u + w - 4 * x[0] + force(x, u, p)) / p)
    return Plant(x, u, w, p, dynamics, DesignSpace(["m"], [1.0], [2.0]), dt=0.02, **options)


@pytest.mark.check
@pytest.mark.parametrize("name", JUMPS)
def test_a_jump_is_not_linear_and_an_accuracy_that_it_forbids_is_refused_by_it(name):
    plant = mass(JUMPS[name])
    assert plant.nonlinear_states == ("x2",)
    method = "auto" if name == "relay" else "rk4"  # by collocation, too, it takes many times as long
    with pytest.raises(InputError, match=r"accuracy: got 1e-06, where .* is reached .*the dynamics of x2 jump"):
        discretise(plant, method=method, **LIMITS)


@pytest.mark.parametrize("jump", [*JUMPS.values(), QUANTISED])
@pytest.mark.parametrize("limits", [LIMITS | {"accuracy": 0.5}, {}], ids=["within limits", "anywhere"])
def test_a_model_of_a_plant_that_jumps_says_so_and_runs_as_the_plant_does(jump, limits):
    plant = mass(jump)
    with pytest.warns(JumpWarning, match="the dynamics of x2 jump"):
        model = discretise(plant, **limits)
    runs = [simulate(one, lambda x: 0.3 + 0 * x[:, :1], x0=[0.8, 0.0], steps=200, design=[1.0]).states
            for one in (model, plant)]  # fmt: skip
    assert np.abs(runs[0] - runs[1]).max() < 0.1


@pytest.mark.long
@pytest.mark.parametrize("name", CONTINUOUS)
def test_a_switch_between_forces_that_meet_is_no_jump(name):
    plant = mass(CONTINUOUS[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error", JumpWarning)
        assert discretise(plant, **LIMITS, accuracy=1e-2).error.relative <= 1e-2
        discretise(plant)
        linearise(plant, [0.0, 0.0])


def test_a_jump_in_the_design_alone_or_outside_the_limits_is_none():
    assert mass(lambda x, u, p: ca.sign(p - 1.5)).linear
    with warnings.catch_warnings():
        warnings.simplefilter("error", JumpWarning)
        discretise(mass(JUMPS["stop"]), X=([-0.4, -2], [0.4, 2]), U=(-3, 3))


def test_what_asks_for_a_linear_plant_names_the_jump():
    plant = mass(JUMPS["friction"])
    for call in (lambda: first_order_hold(plant), lambda: noise_covariance(plant, [[1.0]])):
        with pytest.raises(InputError, match="nonlinear in x, u or w for x2, with sign"):
            call()


def test_a_linearisation_at_a_jump_is_refused_and_beside_it_is_not():
    with pytest.raises(InputError, match=r"about: got a point at which the dynamics of x2 jump \(sign\)"):
        linearise(mass(JUMPS["friction"]), [0.0, 0.0])
    assert linearise(mass(JUMPS["friction"]), [0.0, 0.1]).linear
    assert linearise(mass(JUMPS["stop"]), [0.0, 0.0]).linear


def test_a_discrete_plant_that_jumps_is_said_to_have_derivatives_without_it():
    with pytest.warns(JumpWarning, match="derivatives, and with them the linearisation") as caught:
        discretise(mass(JUMPS["friction"], continuous=False))
    assert "first order" not in str(caught[0].message)


def test_an_output_that_jumps_at_the_point_is_named():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    encoder = Plant(x, u, None, p, -p * x + u, DesignSpace(["p"], [1.0], [2.0]), dt=0.1, outputs=[ca.floor(100 * x)],
                    output_names=["ticks"])  # fmt: skip
    with pytest.raises(InputError, match=r"about: got a point at which ticks jump \(floor\)"):
        linearise(encoder, [0.0])
