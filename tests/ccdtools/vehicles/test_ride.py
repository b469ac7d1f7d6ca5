"""How a vehicle rode: means over runs and wheels, of the states that are named, and in any comparison."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import Trajectory
from ccdtools.exceptions import InputError
from invariant_sets import Polytope

DT = 0.01


def run(states, inputs, diverged=False):
    states, inputs = np.asarray(states, dtype=float), np.asarray(inputs, dtype=float)
    over = np.where(diverged, 0, -1) * np.ones(len(states), dtype=int)
    return Trajectory(states, inputs, np.zeros((*inputs.shape[:2], 1)), over, np.zeros(0), DT)


def sine(amplitude, frequency, steps=2000):
    return amplitude * np.sin(2 * np.pi * frequency * DT * np.arange(steps + 1))


def quarter(stop=0.1):
    return cc.Ride(body=3, travels=[2], tyres=[0], stiffness=2e5, loads=[4000.0], stop=stop)


def test_a_sine_of_every_signal_has_the_values_of_its_amplitude():
    """Twenty seconds of 1 Hz: 0.02 m of travel, 0.005 m of the tyre, 0.1 m/s of the body, a force with the rate."""
    travel = sine(0.02, 1.0)
    rate = 0.02 * 2 * np.pi * np.cos(2 * np.pi * DT * (np.arange(2000) + 0.5))
    states = np.stack([sine(0.005, 1.0), np.zeros(2001), travel, sine(0.1, 1.0)], axis=-1)[None]
    found = quarter()(run(states, (500.0 * rate)[None, :, None]))
    assert found["rms travel [mm]"] == pytest.approx(20 / np.sqrt(2), rel=1e-3)
    assert found["largest travel [% of the stop]"] == pytest.approx(20.0, rel=1e-6)
    assert found["rms tyre load [% of static]"] == pytest.approx(25 / np.sqrt(2), rel=1e-3)
    assert found["off the road [% of the time]"] == 0
    assert found["actuator power [W]"] == pytest.approx(500 * np.mean(rate**2), rel=2e-3)
    weight = 0.482  # of W_k at 1 Hz, in the table of ISO 2631-1
    assert found["weighted body acceleration [m/s²]"] == pytest.approx(weight * 0.1 * 2 * np.pi / np.sqrt(2), rel=0.02)


def test_the_order_of_the_wheels_does_not_matter_but_their_loads_belong_to_them(rng):
    states = 0.01 * rng.standard_normal((3, 101, 5))
    inputs = 100 * rng.standard_normal((3, 100, 2))
    own = cc.Ride(4, [0, 1], [2, 3], 2e5, [4000.0, 3000.0], 0.1)(run(states, inputs))
    turned = cc.Ride(4, [1, 0], [3, 2], 2e5, [3000.0, 4000.0], 0.1)(run(states, inputs[..., ::-1]))
    assert turned == pytest.approx(own)
    other = cc.Ride(4, [0, 1], [2, 3], 2e5, [1000.0, 4000.0], 0.1)(run(states, inputs))
    assert other["rms tyre load [% of static]"] != pytest.approx(own["rms tyre load [% of static]"], rel=1e-3)
    shares = np.sqrt(np.mean(states[:, :, 2:4] ** 2, axis=1)) * 2e5 / [4000.0, 3000.0]
    assert own["rms tyre load [% of static]"] == pytest.approx(100 * shares.mean())
    assert own["largest travel [% of the stop]"] == pytest.approx(1e3 * np.abs(states[..., :2]).max((1, 2)).mean())


def test_forces_that_are_states_do_the_work_instead_of_the_inputs():
    travel = np.linspace(0.0, 0.05, 101)
    states = np.stack([np.zeros(101), np.zeros(101), travel, np.zeros(101), np.full(101, 200.0)], axis=-1)[None]
    ride = cc.Ride(3, [2], [0], 2e5, [4000.0], 0.1, forces=[4])
    assert ride(run(states, np.zeros((1, 100, 1))))["actuator power [W]"] == pytest.approx(200 * 0.05 / 1.0)
    assert quarter()(run(states, np.zeros((1, 100, 1))))["actuator power [W]"] == 0


@pytest.mark.long
def test_a_comparison_shows_metrics_of_the_runs_that_did_not_diverge():
    """A plant that doubles each step: from 0 it stays, from 1 it leaves any limit."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    plant = cc.Plant(x, u, None, None, 2 * x + 0 * u, cc.DesignSpace([], [], []), dt=1.0, continuous=False)
    scenario = cc.Scenario(plant, [[0.0], [1.0]], np.zeros((2, 20, 0)))
    largest = {"largest |x|": lambda r: float(np.abs(r.states).max()), "runs": lambda r: len(r.states)}
    table = cc.compare(
        {"LQR": cc.Passive(1)}, scenario, objective=cc.QuadraticObjective([[1.0]], [[1.0]]), limit=[100.0],
        X=Polytope.from_bounds([-1.0], [1.0]),
        metrics=lambda r: {name: measure(r) for name, measure in largest.items()},
    )  # fmt: skip
    assert table["LQR"].metrics == {"largest |x|": 0.0, "runs": 1.0}
    assert table.rows()[0]["runs"] == 1.0
    assert table.to_frame()["runs"][0] == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"body": -1}, "body: got"),
        ({"body": 1.5}, "body: got"),
        ({"travels": []}, "travels: got"),
        ({"travels": [2, 2]}, "travels: got"),
        ({"tyres": [0, 1]}, "tyres: got 2 states, expected 1, one per travel"),
        ({"forces": [4, 5]}, "forces: got 2 states, expected 1, one per travel"),
        ({"loads": [1.0, 2.0]}, "loads: got"),
        ({"loads": [0.0]}, "loads: got"),
        ({"stiffness": 0.0}, "stiffness: got"),
        ({"stop": -0.1}, "stop: got"),
    ],
)
def test_a_suspension_that_makes_no_sense_is_refused(change, message):
    given = {"body": 3, "travels": [2], "tyres": [0], "stiffness": 2e5, "loads": [4000.0], "stop": 0.1}
    with pytest.raises(InputError, match=message):
        cc.Ride(**(given | change))


def test_a_trajectory_of_another_vehicle_is_refused():
    with pytest.raises(InputError, match="run: got 2 states, expected more than 3"):
        quarter()(run(np.zeros((1, 5, 2)), np.zeros((1, 4, 1))))
    with pytest.raises(InputError, match="run: got 2 inputs, expected 1, one per wheel"):
        quarter()(run(np.zeros((1, 5, 4)), np.zeros((1, 4, 2))))
