"""What test_mpqp_hard.py claims, seen from inside."""

import numpy as np
import pytest
from plants import box, double_integrator

from mpc import LinearMPC
from mpc.explicit.partition import Partition


def integrators(N=4, sx=(1.0, 1.0, 1.0, 1.0), su=(1.0, 1.0), cost=1.0):
    """Two double integrators, with states, inputs and cost in other units."""
    A, B = double_integrator()
    A, B = np.kron(np.eye(2), A), np.kron(np.eye(2), B)
    sx, su = np.array(sx), np.array(su)
    return LinearMPC(
        A * sx[:, None] / sx, B * sx[:, None] / su, Q=cost * np.eye(4) / np.outer(sx, sx),
        R=0.1 * cost * np.eye(2) / np.outer(su, su), horizon=N, X=box(5 * sx), U=box(su),
    )  # fmt: skip


@pytest.fixture(scope="module")
def natural():
    return integrators(2).explicit()


def test_a_partition_is_small_to_print_and_can_be_copied(natural):
    import copy
    import pickle

    for again in (pickle.loads(pickle.dumps(natural)), copy.deepcopy(natural)):
        np.testing.assert_array_equal(again.law, natural.law)
        np.testing.assert_array_equal(again([1.0, 0, 0, 1]), natural([1.0, 0, 0, 1]))
        assert isinstance(again.partition, Partition)
        assert not again.partition.law.flags.writeable
        assert len(repr(again)) < 250
    with pytest.raises(ValueError, match="read-only"):
        natural.law[0] = 0.0
