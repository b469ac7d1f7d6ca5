"""Replays: windows and whole runs of logged errors are exact."""

from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, disturbances, start

from ccdtools import InputError, LearnedPolicy, deploy, simulate
from ccdtools.twin import replay_problem
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import residuals


@pytest.fixture(scope="module")
def log(illustrative, clone):
    """Return a log of the clone on the real plant: four runs."""
    policy = LearnedPolicy(clone(illustrative), DESIGN)
    return deploy(illustrative.real.plant, policy, DESIGN, disturbances(illustrative, 4, 50), x0=start(4))


def test_windows_reproduce_the_logged_trajectory_exactly_under_the_logged_inputs(illustrative, log):
    errors_of_the_log = residuals(illustrative.model, log)
    problem = replay_problem(illustrative.problem(), [errors_of_the_log], 15)
    x0, w = problem.scenarios.sample(40, 15, np.random.default_rng(0))
    for start_state, errors in zip(x0, w):
        same_start = (log.states[:, :-1] == start_state).all(axis=-1)
        same_error = np.isclose(errors_of_the_log.e_next, errors[0, :2] + errors[0, 2:]).all(axis=-1)
        ((run, k),) = np.argwhere(same_start & same_error)
        inputs = iter(log.inputs[run, k : k + 15])
        again = simulate(
            problem.model, lambda x, inputs=inputs: next(inputs)[None], x0=start_state, steps=15, disturbance=errors,
            design=DESIGN,
        )  # fmt: skip
        np.testing.assert_allclose(again.states[0], log.states[run, k : k + 16], atol=1e-12)


def test_every_window_of_every_stretch_can_be_drawn(illustrative, log):
    r = residuals(illustrative.model, log)
    one, three, short = (slice(0, 1), slice(0, 12)), (slice(1, 4), slice(20, 33)), (slice(0, 1), slice(0, 5))
    stretches = tuple(r.part(*stretch) for stretch in (one, three, short))
    x0, w = Replay(stretches).sample(3000, 10, np.random.default_rng(0))
    assert w.shape == (3000, 10, 2)
    expected = np.vstack([r.x[0, :3], *(r.x[i, 20:24] for i in (1, 2, 3))])
    drawn, counts = np.unique(x0, axis=0, return_counts=True)
    np.testing.assert_array_equal(drawn, np.unique(expected, axis=0))
    assert counts.min() > 3000 / 15 * 0.6


def test_whole_runs_begin_where_the_log_began_and_meet_all_of_its_errors(illustrative, log):
    r = residuals(illustrative.model, log)
    one, three = r.part(slice(0, 1), slice(None)), r.part(slice(1, 4), slice(None))
    x0, w = Replay((three, one)).whole()
    np.testing.assert_array_equal(x0, log.states[[1, 2, 3, 0], 0])
    np.testing.assert_array_equal(w, r.e_next[[1, 2, 3, 0]])
    with pytest.raises(InputError, match="logs: got runs of 20 to 50 steps, expected logs of one length"):
        Replay((r, r.part(slice(0, 1), slice(0, 20)))).whole()


def test_runs_keep_their_numbers_where_others_were_lost(illustrative, log):
    lost = replace(log, diverged_at=np.array([-1, 3, -1, -1]))
    np.testing.assert_array_equal(residuals(illustrative.model, lost).numbers, [0, 2, 3])
    np.testing.assert_array_equal(residuals(illustrative.model, lost).part(slice(1, 3), slice(None)).numbers, [2, 3])
    with pytest.raises(InputError, match="numbers: got shape"):
        replace(residuals(illustrative.model, log), numbers=np.arange(3))


def test_a_replay_longer_than_the_log_is_refused(illustrative, log):
    with pytest.raises(InputError, match="steps: got 51, expected at most 50"):
        Replay((residuals(illustrative.model, log),)).sample(3, 51, np.random.default_rng(0))


def test_the_replay_problem_lets_errors_enter_through_E_and_their_rest_as_it_is(illustrative, log):
    problem = replay_problem(illustrative.problem(), [residuals(illustrative.model, log)], 15)
    A, B, E = problem.model.matrices(DESIGN)
    np.testing.assert_array_equal(E, np.hstack([illustrative.model.matrices(DESIGN)[2], np.eye(2)]))
    np.testing.assert_array_equal(A, illustrative.model.matrices(DESIGN)[0])
    np.testing.assert_array_equal(B, illustrative.model.matrices(DESIGN)[1])
    assert problem.steps == 15
    assert problem.discrepancy is None
