"""What test_point_location.py claims, seen from inside."""

import time

import numpy as np
import pytest
from partitions import stacked_integrators

from mpc import ExplicitMPC, solve_mpqp
from mpc.explicit import search_tree
from mpc.explicit.kernels import growth
from mpc.explicit.search_tree import TreeStatus


@pytest.fixture(scope="module")
def partition():
    mpc = stacked_integrators(4)
    return solve_mpqp(mpc.build(), mpc.X)  # 23² regions in four states


def samples(partition, spread, count=4000):
    t = np.random.default_rng(0).uniform(-1, 1, size=(count, len(partition.half)))
    return partition.centre + spread * partition.half * t


@pytest.mark.long
@pytest.mark.parametrize("spread", [1.0, 1.3, 50.0, 1e200])
def test_tree_scan_and_stopped_tree_give_the_same_input(partition, spread):
    tree = ExplicitMPC.from_partition(partition)
    stopped = ExplicitMPC.from_partition(partition, tree_time_limit=1e-9)
    scan = ExplicitMPC.from_partition(partition, method="sequential")
    assert [law.tree.status for law in (tree, stopped, scan)] == [
        TreeStatus.COMPLETE, TreeStatus.TIME_LIMIT, TreeStatus.SEQUENTIAL,
    ]  # fmt: skip
    theta = samples(partition, spread)
    u, outside = tree.evaluate(theta)
    for law, method in ((tree, "sequential"), (stopped, "tree"), (scan, "tree")):
        v, beyond = law.evaluate(theta, method=method)
        np.testing.assert_array_equal(beyond, outside)
        np.testing.assert_allclose(v, u, atol=1e-9)
    np.testing.assert_array_equal(tree.locate(theta) < 0, outside)


def test_a_tree_that_grows_too_large_is_stopped_and_still_right(partition, monkeypatch):
    monkeypatch.setattr(search_tree, "LEAF_ENTRIES", -18)
    monkeypatch.setattr(search_tree, "TESTS_AT_ONCE", 100)
    law = ExplicitMPC.from_partition(partition)
    assert law.tree.status is TreeStatus.SIZE_LIMIT
    theta = samples(partition, 1.1)
    np.testing.assert_allclose(law(theta), law.evaluate(theta, method="sequential")[0], atol=1e-9)


def test_limits_of_the_whole_way_are_passed_on():
    mpc = stacked_integrators(3)
    law = mpc.explicit(method="sequential")
    assert law.tree.status is TreeStatus.SEQUENTIAL
    assert "method='tree'" in law.tree.status.advice
    assert mpc.explicit(tree_time_limit=1e-9).tree.status is TreeStatus.TIME_LIMIT


@pytest.mark.long
def test_compiling_does_not_count_as_time_of_the_tree(partition, monkeypatch):
    grown, calls = growth.grow, []

    def compiled_first(*given):
        time.sleep(0.0 if calls else 1.0)
        calls.append(given)
        return grown(*given)

    monkeypatch.setattr(growth, "grow", compiled_first)
    law = ExplicitMPC.from_partition(partition, tree_time_limit=0.9)
    assert len(calls) > 1
    assert law.tree.status is TreeStatus.COMPLETE
