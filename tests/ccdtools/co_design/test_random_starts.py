"""Episodes that start at random."""

import numpy as np
import pytest
from scipy import stats

from ccdtools import (
    CoDesignProblem,
    FixedStart,
    Gaussian,
    InputError,
    QuadraticObjective,
    RandomStarts,
    baselines,
    discretise,
    least_depth,
)
from ccdtools.co_design import expert_dataset, feasible_sets
from ccdtools.disturbances import Cases, Constant, Mixture, Stacked, Sum, Uniform
from ccdtools.plants.library import mass_chain
from invariant_sets import Polytope

NOISE = Gaussian([0.1])
OUT, IN = Uniform([0, 0], [1, 4.1]), Uniform([0, 0], [0.1, 0.1])
REACHING = [
    Mixture((Gaussian([0.1, 0.1]), OUT)), Mixture((IN, Mixture((IN, OUT)))), Constant(OUT), Cases((OUT, IN)),
    Cases.of([[0, 0], [0, -4.1]]), Stacked((Uniform([0], [1]), Uniform([0], [4.1]))),
    Sum((IN, Uniform([0, 0], [1, 4]))),
]  # fmt: skip


def simplex(n, scale):
    """{x ≥ 0, sum x / scale ≤ 1}: 1/n! of its box."""
    return Polytope(np.vstack([-np.eye(n), np.ones((1, n)) / scale]), np.r_[np.zeros(n), 1.0])


@pytest.mark.parametrize(("n", "scale"), [(2, 1.0), (3, 1e-4), (5, 300.0), (7, 1.0)])
def test_starts_in_a_simplex_have_the_dirichlet_distribution(n, scale, rng):
    x0, _ = RandomStarts(simplex(n, scale), NOISE).sample(4000, 1, rng)
    share = np.c_[x0 / scale, 1 - x0.sum(axis=1) / scale]
    for column in share.T:  # every barycentric coordinate is Beta(1, n)
        assert stats.kstest(column, stats.beta(1, n).cdf).pvalue > 1e-4


def test_starts_in_a_slanted_set_are_those_of_the_upright_one(rng):
    shear = np.array([[1.0, 0.0], [30.0, 0.1]])
    box = Polytope.from_bounds([-1, -1], [1, 1])
    x0, _ = RandomStarts(Polytope(box.A @ np.linalg.inv(shear), box.b), NOISE).sample(4000, 1, rng)
    for column in (x0 @ np.linalg.inv(shear).T).T:
        assert stats.kstest(column, stats.uniform(-1, 2).cdf).pvalue > 1e-4


def test_a_distribution_gives_one_state_a_run(rng):
    mixed = Mixture((Uniform([1, 1], [2, 2]), Gaussian([0.0, 0.0])), weights=(1, 1))
    x0, w = RandomStarts(mixed, Constant(NOISE)).sample(2000, 4, rng)
    assert x0.shape == (2000, 2)
    assert (x0 == 0).all(axis=1).mean() == pytest.approx(0.5, abs=0.05)
    assert (w == w[:, :1]).all()


def test_given_states_are_drawn_as_their_weights_say(rng):
    states = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    x0, _ = RandomStarts(states, NOISE, weights=[1, 0, 3]).sample(4000, 1, rng)
    counts = [(x0[:, 0] == value).mean() for value in (1, 2, 3)]
    np.testing.assert_allclose(counts, [0.25, 0, 0.75], atol=0.03)
    x0, _ = RandomStarts(states, NOISE).sample(4000, 1, rng)
    assert (x0[:, 0] == 2).mean() == pytest.approx(1 / 3, abs=0.03)


def problem_from(scenarios, steps=30):
    """One mass between springs."""
    return CoDesignProblem(
        discretise(mass_chain(1)), X=([-1.0, -4.0], [1.0, 4.0]), U=(-20.0, 20.0),
        objective=QuadraticObjective(np.diag([10.0, 1.0]), [[0.01]]), scenarios=scenarios, steps=steps,
    )  # fmt: skip


@pytest.mark.parametrize("starts", [Mixture((OUT, IN), [0, 1]), Cases((IN, IN)), Sum((IN, Gaussian([0.1, 0.1])))])
def test_starts_within_limits_or_without_any_are_taken(starts):
    assert problem_from(RandomStarts(starts, NOISE)).scenarios.x0 is starts


@pytest.mark.check
def test_a_problem_takes_them_and_its_expert_starts_there(rng):
    S = Polytope.from_bounds([0.2, 1.0], [0.4, 2.0])
    problem = problem_from(RandomStarts(S, NOISE))
    data = expert_dataset(problem, samples=40, sets="none", rng=rng)
    assert len(data.inputs) > 40
    x0, w = problem.scenarios.sample(10, problem.steps, rng)
    assert S.contains(x0).all()
    assert w.shape == (10, 30, 1)
    assert least_depth(problem, [100.0, 1.0]) >= 0
    assert set(baselines(problem, [100.0, 1.0], rng=rng)) == {"passive", "LQR", "PID", "MPC"}


def test_a_constant_stays_the_same_beyond_an_episode(rng):
    for scenarios in (FixedStart([0.1, 0.0], Constant(NOISE)), RandomStarts([[0.1, 0.0]], Constant(NOISE))):
        w = problem_from(scenarios).driving(5, 100, rng)
        assert w.shape == (5, 100, 1)
        assert (w == w[:, :1]).all()


def test_the_feasible_set_of_a_design_is_a_place_to_start(rng):
    problem = problem_from(FixedStart([0.1, 0.0], NOISE))
    S = feasible_sets(problem).result([50.0, 0.5]).set
    x0, _ = problem_from(RandomStarts(S, NOISE)).scenarios.sample(500, 3, rng)
    assert S.contains(x0).all()
    assert (np.ptp(x0, axis=0) > 0.8 * np.subtract(*S.bounding_box()[::-1])).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomStarts([0.0, 1.0], NOISE), r"x0: got shape \(2,\).* One state is a FixedStart"),
        (lambda: RandomStarts("middle", NOISE), "x0: got 'middle', expected a Polytope"),
        (lambda: RandomStarts(np.zeros((0, 2)), NOISE), "x0: got shape"),
        (lambda: RandomStarts(Uniform, NOISE), "x0: got the class Uniform"),
        (lambda: RandomStarts(Polytope([[1.0, 0.0]], [1.0]), NOISE), "x0: got an unbounded set"),
        (lambda: RandomStarts(Polytope([[1.0], [-1.0]], [0.0, -1.0]), NOISE), "x0: got an empty set"),
        (lambda: RandomStarts(Polytope.from_bounds([0, 1], [2, 1]), NOISE), "x0: got a set without an interior"),
        (lambda: RandomStarts([[0.0]], 0.1), "disturbance: got 0.1"),
        (lambda: RandomStarts([[0.0]], NOISE, weights=[1, 2]), "weights: got shape"),
        (lambda: RandomStarts(Uniform([0], [1]), NOISE, weights=[1]), "weights: got .* expected nothing"),
        (lambda: problem_from(RandomStarts([[0.0, 0.0], [2.0, 0.0]], NOISE)), "x0: got .* as state 2, .* outside X"),
        (lambda: problem_from(RandomStarts(Uniform([0, 0], [1, 4.1]), NOISE)), "scenarios.x0: .* reaches outside X"),
        (lambda: problem_from(RandomStarts(simplex(2, 1.5), NOISE)), "scenarios.x0: .* reaches outside X"),
        *((lambda s=s: problem_from(RandomStarts(s, NOISE)), "scenarios.x0: .* reaches outside X") for s in REACHING),
        (lambda: problem_from(RandomStarts(Uniform([0], [1]), NOISE)), r"initial states of shape \(1,\)|dimension"),
    ],
)
def test_bad_starts_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
