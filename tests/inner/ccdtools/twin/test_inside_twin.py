"""What test_twin.py claims, seen from inside."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import InputError, LinearFeedback, Trajectory, simulate
from ccdtools.controllers import Passive
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.residuals import block_parts, residuals, stacked
from learning.quantile import QuantileNetwork
from mpc import lqr

DESIGN = [2.0]


def driven(study, design, runs, steps, seed, real=True):
    """A log of saturated LQR on the real plant."""
    A, B, _ = study.model.matrices(design)
    law = LinearFeedback(lqr(A, B, Q=study.objective.Q, R=study.objective.R)[0], *study.problem().input_bounds)
    rng = np.random.default_rng(seed)
    return simulate(
        study.real.plant if real else study.model, law, x0=np.tile([-2.0, -2.0], (runs, 1)), steps=steps,
        disturbance=study.real.disturbance, design=design, limit=study.problem().limit, rng=rng,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log(illustrative):
    return driven(illustrative, DESIGN, 60, 100, 0)


def test_the_error_is_the_one_step_residual_at_the_measured_state(illustrative, log):
    r = residuals(illustrative.model, log)
    A, B, _ = illustrative.model.matrices(DESIGN)
    for k in (0, 1, 57):
        expected = log.states[:, k + 1] - log.states[:, k] @ A.T - log.inputs[:, k] @ B.T
        np.testing.assert_allclose(r.e_next[:, k], expected, atol=1e-12)
    np.testing.assert_array_equal(r.x, log.states[:, :-1])
    np.testing.assert_array_equal(r.u, log.inputs)
    np.testing.assert_array_equal(r.p, DESIGN)


def test_the_error_starts_at_zero_and_is_handed_on(illustrative, log):
    r = residuals(illustrative.model, log)
    assert not r.e[:, 0].any()
    np.testing.assert_array_equal(r.e[:, 1:], r.e_next[:, :-1])


def test_on_the_model_itself_the_error_is_the_disturbance(illustrative):
    log = driven(illustrative, DESIGN, 3, 50, 0, real=False)
    np.testing.assert_allclose(residuals(illustrative.model, log).e_next, log.disturbances, atol=1e-12)


def test_diverged_runs_teach_nothing(illustrative, log):
    lost = replace(log, diverged_at=np.r_[5, np.full(59, -1)])
    assert len(residuals(illustrative.model, lost).x) == 59
    with pytest.raises(InputError, match="log: got 60 runs that all diverged, expected at least one"):
        residuals(illustrative.model, replace(log, diverged_at=np.zeros(60, dtype=int)))


def test_a_part_is_a_stretch_of_every_column(illustrative, log):
    r = residuals(illustrative.model, log)
    part = r.part(slice(2, 4), slice(10, 15))
    np.testing.assert_array_equal(part.e_next, r.e_next[2:4, 10:15])
    assert part.x.shape == (2, 5, 2)
    np.testing.assert_array_equal(part.p, r.p)


def counted(runs, steps, illustrative):
    """A log whose states count the samples."""
    states = np.empty((runs, steps + 1, 2))
    states[:] = (np.arange(steps + 1) + 1000 * np.arange(runs)[:, None])[..., None]
    log = Trajectory(
        states, np.zeros((runs, steps, 1)), np.zeros((runs, steps, 2)), np.full(runs, -1), np.array(DESIGN), 1.0
    )
    return residuals(illustrative.model, log)


def test_a_long_run_holds_out_the_end_of_every_block(illustrative):
    r = counted(1, 100, illustrative)
    parts = block_parts(r, 0.2, 10, last=False)
    _, x, _, p, _ = stacked(parts)
    _, held, *_ = stacked(block_parts(r, 0.2, 10, last=True))
    assert [part.steps for part in parts] == [8] * 10
    np.testing.assert_array_equal(x[:, 0] % 10, np.tile(np.arange(8), 10))
    np.testing.assert_array_equal(held[:, 0] % 10, np.tile([8, 9], 10))
    np.testing.assert_array_equal(p, np.full((80, 1), 2.0))
    assert sorted(np.r_[x[:, 0], held[:, 0]]) == list(range(100))


def test_of_several_runs_the_last_are_held_out_whole(illustrative):
    r = counted(5, 20, illustrative)
    parts = block_parts(r, 0.2, 10, last=False)
    _, x, *_ = stacked(parts)
    _, held, *_ = stacked(block_parts(r, 0.2, 10, last=True))
    assert [part.runs * part.steps for part in parts] == [80]
    assert set(held[:, 0] // 1000) == {4}
    assert set(x[:, 0] // 1000) == {0, 1, 2, 3}


def network():
    net = QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (6,), seed=3)
    net.output_scale.fill_(0.2)
    return net


def test_draws_run_through_the_quantiles_and_straight_beyond_them():
    net = network()
    net.positions = torch.tensor([[-0.25, -0.25], [0.0, 0.0], [1.0, 1.0], [1.5, 1.5], [2.25, 2.25]])
    d = Discrepancy(net, np.eye(2), noise="quantiles")
    e, x, u, p = torch.randn(4, 2), torch.randn(4, 2), torch.randn(4, 1), torch.tensor([1.0])
    with torch.no_grad():
        q = d.network(d.features(e, x, u, p))

        def draw(level):
            return d.errors(p)(e, x, u, torch.full((4, 2), level))

        for level, k in ((0.3, 0), (0.5, 1)):
            torch.testing.assert_close(draw(level), q[:, k])
        torch.testing.assert_close(draw(0.7), (q[:, 1] + q[:, 2]) / 2)
        torch.testing.assert_close(draw(1.0), q[:, 2] + (q[:, 2] - q[:, 1]) / 4)
        torch.testing.assert_close(draw(0.0), q[:, 0] - (q[:, 1] - q[:, 0]) / 4)


def test_noise_adds_nothing_or_what_was_given():
    e, x, u, p, w = torch.randn(4, 2), torch.randn(4, 2), torch.randn(4, 1), torch.tensor([1.0]), torch.randn(4, 2)
    with torch.no_grad():
        d = Discrepancy(network(), np.eye(2))
        silent, penalty = d.errors(p)(e, x, u, w), d.penalty(e, x, u, p)
        replayed = Discrepancy(network(), np.eye(2), noise="replayed").errors(p)(e, x, u, w)
    torch.testing.assert_close(replayed, silent + w)
    assert (penalty > 0).all()


def test_unknown_noise_is_refused():
    with pytest.raises(InputError, match="noise: got 'pink', expected one of none, quantiles, replayed"):
        Discrepancy(network(), np.eye(2), noise="pink")


def test_the_updated_model_is_a_plant_that_remembers_its_error(illustrative):
    d = Discrepancy(network(), np.eye(2))
    plant = TwinPlant(illustrative.model, d)
    assert (plant.nx, plant.nu, plant.nw, plant.dt) == (2, 1, 2, 1.0)
    run = simulate(plant, LinearFeedback([[0.2, 0.3]], [-1], [1]), x0=[[1.0, 0.5], [0.0, -1.0]], steps=5, design=DESIGN)
    A, B, _ = illustrative.model.matrices(DESIGN)
    e = np.zeros((2, 2))
    for k in range(5):
        x, u = run.states[:, k], run.inputs[:, k]
        features = np.hstack([e, x, u])
        e = d.network.predict(features)[:, 1]
        np.testing.assert_allclose(run.states[:, k + 1], x @ A.T + u @ B.T + e, rtol=1e-5, atol=1e-6)


def test_every_simulation_of_the_updated_model_starts_without_an_error(illustrative):
    plant = TwinPlant(illustrative.model, Discrepancy(network(), np.eye(2)))
    first, again = (simulate(plant, Passive(), x0=[1.0, 0.5], steps=4, design=DESIGN).states for _ in range(2))
    np.testing.assert_array_equal(first, again)
