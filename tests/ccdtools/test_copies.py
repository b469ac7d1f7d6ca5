"""Public objects are copied and pickled, stay read-only, do the same as before, and print in a line or a few."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
from joblib import Parallel, delayed

import ccdtools as cc
from mpc import LinearMPC

P = np.array([2.0])


def twice(thing):
    """The object deep-copied, and the object pickled and read back."""
    return copy.deepcopy(thing), pickle.loads(pickle.dumps(thing))


@pytest.mark.long
def test_a_copied_plant_steps_as_the_original(study, rng):
    x, u = rng.standard_normal((9, study.plant.nx)), rng.standard_normal((9, 1))
    w = rng.standard_normal((9, study.plant.nw))
    for plant in (study.plant, study.real.plant):
        for other in twice(plant):
            for n in (1, 9):
                expected = plant.stepper(study.p0, batch=n)(x[:n], u[:n], w[:n])
                np.testing.assert_array_equal(other.stepper(study.p0, batch=n)(x[:n], u[:n], w[:n]), expected)


def test_a_copied_plant_keeps_the_names_of_its_symbols(suspension):
    for other in twice(suspension.plant):
        assert [s.name() for s in ca.symvar(other.dynamics)] == [s.name() for s in ca.symvar(suspension.plant.dynamics)]
        assert other.state_names == suspension.plant.state_names


def test_a_copied_model_has_the_same_matrices_and_derivatives(study):
    for other in twice(study.model):
        for own, expected in zip(other.matrices(study.p0), study.model.matrices(study.p0)):
            np.testing.assert_array_equal(own, expected)
        for own, expected in zip(other.derivatives(study.p0), study.model.derivatives(study.p0)):
            np.testing.assert_array_equal(own, expected)
    again = cc.discretise(twice(study.plant)[1], sampling_guard="ignore")
    np.testing.assert_array_equal(again.matrices(study.p0)[0], study.model.matrices(study.p0)[0])


def test_a_copied_policy_acts_as_the_original(illustrative, clone, rng):
    policy, x = cc.LearnedPolicy(clone(illustrative), P), rng.standard_normal((20, 2))
    for other in twice(policy):
        np.testing.assert_array_equal(other(x), policy(x))


def test_a_copied_pid_starts_with_no_past():
    pid = cc.PID([[1.0]], [0], [1.0], [0], dt=1.0, lower=[-9], upper=[9])
    pid([1.0])
    for other in twice(pid):
        assert other([1.0]) == pytest.approx([-1.0])
    assert pid([1.0]) == pytest.approx([-2.0])


def returned(problem, policy, seed):
    """Mean return of a policy on a problem, for a sweep."""
    x0, w = problem.scenarios.sample(5, 20, np.random.default_rng(seed))
    run = cc.Scenario(problem.model, x0, w).run(policy, design=policy.design)
    return run.returns(problem.objective).mean()


@pytest.mark.check
def test_a_sweep_in_processes_gives_what_a_loop_gives(illustrative, clone):
    problem, policy = illustrative.problem(), cc.LearnedPolicy(clone(illustrative), P)
    jobs = [(problem, policy, seed) for seed in range(3)]
    swept = Parallel(n_jobs=2, backend="loky")(delayed(returned)(*job) for job in jobs)
    assert swept == [returned(*job) for job in jobs]


def test_arrays_are_read_only_copies_of_what_was_given_and_stay_so():
    states, inputs, disturbances = np.zeros((1, 3, 2)), np.zeros((1, 2, 1)), np.zeros((1, 2, 1))
    run = cc.Trajectory(states, inputs, disturbances, dt=0.1, design=np.zeros(1), diverged_at=[-1])
    law = LinearMPC([[1, 0.1], [0, 1]], [[0], [0.1]], Q=np.eye(2), R=1.0, horizon=3, U=(-1, 1))
    states[:] = 7.0
    assert not run.states.any()
    assert states.flags.writeable
    for one in (run, *twice(run)):
        assert not any(getattr(one, name).flags.writeable for name in ("states", "inputs", "design", "diverged_at"))
    for one in (law, *twice(law)):
        assert not any(getattr(one, name).flags.writeable for name in ("A", "B", "Q", "P"))
