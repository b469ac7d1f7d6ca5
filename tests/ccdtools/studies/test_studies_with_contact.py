"""The studies of a wall, of backlash and of a swing-up: what their real plants do."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import DesignSpace
from ccdtools.plants import from_gymnasium
from ccdtools.studies import load_study


def stepped(plant, x, u, p, steps=1):
    """States after samples of a constant input, without disturbances."""
    x = np.atleast_2d(np.asarray(x, float))
    step, u = plant.stepper(np.asarray(p, float), batch=len(x)), np.broadcast_to(u, (len(x), plant.nu))
    for _ in range(steps):
        x = step(x, u, np.zeros((len(x), plant.nw)))
    return x


def test_the_real_pendulum_is_the_one_of_gymnasium():
    gymnasium = pytest.importorskip("gymnasium")
    real = load_study("swing_up").real.plant

    def write(env, x):
        env.state = x

    def build(env, p):
        (env.l,) = p

    space = DesignSpace(["l"], [0.8], [1.25], ["m"])
    env = from_gymnasium(
        gymnasium.make("Pendulum-v1"), read=lambda env: env.state, write=write, dt=0.05, design=space, build=build
    )
    rng = np.random.default_rng(0)
    for length in (0.8, 1.0, 1.25):
        x = rng.uniform([-4, -8], [4, 8], (20, 2))
        u = rng.uniform(-3, 3, (20, 1))
        np.testing.assert_allclose(stepped(real, x, u, [length]), stepped(env, x, u, [length], 2), atol=1e-5)


def test_the_real_wall_leaves_about_as_much_speed_as_the_model_says():
    study = load_study("wall")
    for speed in (1.0, 3.0):
        start = [-0.4, -speed]
        for mass in (0.5, 1.0, 2.0):
            model = -stepped(study.plant, start, 0.0, [mass], 5)[0, 1] / -speed
            real = stepped(study.real.plant, start, 0.0, [mass], 5)[0, 1] / speed
            assert model == pytest.approx(0.8)
            assert 0.6 < real < 0.95


def test_the_steps_of_the_real_wall_are_short_enough_where_runs_meet_it():
    real = load_study("wall").real.plant
    start = np.random.default_rng(0).uniform([-0.45, -4.0], [0.0, -1.0], (50, 2))
    fine = stepped(replace(real, substeps=640), start, 0.0, [0.5], 3)
    np.testing.assert_allclose(stepped(real, start, 0.0, [0.5], 3), fine, atol=0.02)


def test_a_gear_in_its_gap_passes_no_torque_on():
    real = load_study("backlash_servo").real.plant
    p, rest = [20.0, 2e-3], np.zeros(2)
    for twist in (-0.029, 0.01, 0.029):
        np.testing.assert_array_equal(stepped(real, [*rest, twist, 0.0], 0.0, p)[0, :2], rest)
    touching = stepped(real, [[*rest, side * 0.05, 0.0] for side in (-1, 1)], 0.0, p)
    assert touching[1, 1] > 0.1
    np.testing.assert_allclose(touching[0], -touching[1])
