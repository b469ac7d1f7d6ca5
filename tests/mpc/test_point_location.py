"""Point location: every method gives the same input, inside and outside, whatever limit stopped the tree."""

import numpy as np
import pytest
from partitions import integrator, stacked_integrators
from plants import box
from random_problems import random_plant

from mpc import ExplicitMPC, InputError, LinearMPC, solve_mpqp


@pytest.fixture(scope="module")
def partition():
    mpc = stacked_integrators(4)
    return solve_mpqp(mpc.build(), mpc.X)  # 23² regions in four states


def samples(partition, spread, count=4000):
    t = np.random.default_rng(0).uniform(-1, 1, size=(count, len(partition.half)))
    return partition.centre + spread * partition.half * t


def test_outside_the_input_is_that_of_the_point_on_the_border():
    mpc = integrator(5, 0.1)
    law = mpc.explicit()
    centre = law.partition.centre + law.partition.half * law.tree.centre
    theta = samples(law.partition, 3.0, 300)
    u, outside = law.evaluate(theta)
    assert outside.sum() > 100
    for x, ux in zip(theta[outside], u[outside]):
        share = np.linspace(0, 1, 2001)
        along = centre + share[:, None] * (x - centre)
        v, beyond = law.evaluate(along)
        assert not beyond[0]
        first = int(np.argmax(beyond))
        assert beyond[first:].all()  # the feasible set is convex
        np.testing.assert_allclose(v[first:], np.tile(ux, (len(share) - first, 1)), atol=1e-9)
        assert np.abs(v[first - 1] - ux).max() < 0.1


def test_the_border_is_that_of_the_feasible_set():
    for seed in (5, 8, 12):
        law = random_plant(seed).explicit()
        t = np.random.default_rng(seed).uniform(-1, 1, size=(20_000, law.nt))
        within = (t @ law.tree.border[:, :-1].T <= law.tree.border[:, -1] + 1e-7).all(axis=1)
        outside = law.evaluate(law.partition.centre + law.partition.half * t)[1]
        np.testing.assert_array_equal(within, ~outside)


def test_a_partition_cut_short_has_no_border_and_takes_the_nearest_region():
    mpc = stacked_integrators(3)
    law = mpc.explicit(max_regions=40)
    assert len(law.tree.border) == 0
    theta = samples(law.partition, 1.0)
    (u, outside), (v, beyond) = law.evaluate(theta), law.evaluate(theta, method="sequential")
    assert 0.1 < outside.mean() < 0.99
    np.testing.assert_array_equal(outside, beyond)
    np.testing.assert_allclose(u, v, atol=1e-9)
    assert np.abs(u).max() <= 1.0 + 1e-12


WRONG = {
    "theta as text": lambda law: law("state"),
    "theta too wide": lambda law: law([1.0, 2.0, 3.0]),
    "theta as a number": lambda law: law(1.0),
    "theta in three dimensions": lambda law: law(np.zeros((2, 2, 2))),
    "theta with NaN": lambda law: law([np.nan, 0.0]),
    "theta infinite": lambda law: law.value([np.inf, 0.0]),
    "theta complex": lambda law: law([1j, 0.0]),
    "theta None": lambda law: law(None),
    "theta ragged": lambda law: law([[1.0], [1.0, 2.0]]),
    "theta an object": lambda law: law.locate(object()),
    "unknown method": lambda law: law.evaluate([0.0, 0.0], method="hash"),
    "method None": lambda law: law.locate([0.0, 0.0], method=None),
    "unknown method of the law": lambda law: ExplicitMPC.from_partition(law.partition, method="hash"),
    "negative time for the tree": lambda law: ExplicitMPC.from_partition(law.partition, tree_time_limit=-1),
    "NaN for the tree": lambda law: ExplicitMPC.from_partition(law.partition, tree_time_limit=np.nan),
    "time as text": lambda law: ExplicitMPC.from_partition(law.partition, tree_time_limit="1"),
    "no partition": lambda law: ExplicitMPC.from_partition(None),
    "a law as a partition": lambda law: ExplicitMPC.from_partition(law),
    "input rows that are no pair": lambda law: ExplicitMPC.from_partition(law.partition, 3),
    "input rows too wide": lambda law: ExplicitMPC.from_partition(law.partition, (np.eye(2), np.ones(2))),
    "an unknown picture": lambda law: law.plot("volume"),
    "one axis": lambda law: law.plot(axes=(0,)),
    "the same axis twice": lambda law: law.plot(axes=(1, 1)),
    "axes as text": lambda law: law.plot(axes="xy"),
    "an axis None": lambda law: law.plot(axes=(None, 1)),
    "an axis as a float": lambda law: law.plot(axes=(0.5, 1)),
    "an input that does not exist": lambda law: law.plot("law", component=1),
    "no points": lambda law: law.plot("law", points=0),
    "points as text": lambda law: law.plot("law", points="many"),
    "a section of the wrong size": lambda law: law.plot(at=[0.0]),
    "a C name with a blank": lambda law: law.to_c("x", name="my law"),
    "a C name None": lambda law: law.to_c("x", name=None),
    "a C name in Greek": lambda law: law.to_c("x", name="θ"),
    "an unknown scalar": lambda law: law.to_c("x", scalar="half"),
    "an unknown search": lambda law: law.to_c("x", method=1),
    "a folder None": lambda law: law.to_c(None),
    "a save to a number": lambda law: law.save(1),
}


@pytest.mark.parametrize("call", WRONG)
def test_wrong_calls_are_refused_in_one_line(call):
    import matplotlib as mpl

    mpl.use("Agg")
    law = integrator(2, 0.1).explicit(method="sequential")
    with pytest.raises(InputError) as caught:
        WRONG[call](law)
    assert caught.value.expected is not None
    assert "\n" not in str(caught.value)


def test_wrong_calls_of_the_controller_are_refused_in_one_line():
    mpc = integrator(2, 0.1)
    wrong = [dict(theta_set="X"), dict(theta_set=box([1.0])), dict(theta_set=3), dict(max_regions=0),
             dict(max_regions=2.5), dict(time_limit=0), dict(time_limit="1"), dict(tree_time_limit=0),
             dict(tree_time_limit="short"), dict(method="walk"), dict(parameters=("y",))]  # fmt: skip
    for options in wrong:
        with pytest.raises(InputError) as caught:
            mpc.explicit(**options)
        assert "\n" not in str(caught.value)
    unbounded = LinearMPC(mpc.A, mpc.B, Q=np.eye(2), R=[[1.0]], horizon=2, U=box([1]))
    with pytest.raises(InputError, match=r"theta_set: got None, expected a bounded Polytope of the parameters \['x'\]"):
        unbounded.explicit()
