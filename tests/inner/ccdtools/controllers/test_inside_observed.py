"""What test_observed.py claims, seen from inside."""

import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import InputError, KalmanFilter, LinearFeedback, Measurement
from ccdtools.controllers import Observed
from ccdtools.controllers.signals import needs_of
from ccdtools.estimation.belief import Belief
from invariant_sets import Polytope
from mpc import LinearMPC, OffsetFreeMPC, lqr

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
C = np.array([[1.0, 0.0]])
W, V = np.diag([1e-5, 1e-4]), np.array([[1e-4]])
X = Polytope.from_bounds([-2.0, -0.5], [2.0, 0.5])
U = Polytope.from_bounds([-1.0], [1.0])
MODEL = cc.LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.1), E=np.eye(2))
K, _ = lqr(A, B, Q=np.eye(2), R=[[0.1]])
STEADY = KalmanFilter(A, B, C, W, V)
X0 = np.array([[-1.0, 0.0], [0.5, 0.2], [0.3, -0.1]])
STEPS = 30
NOISE = 0.01 * np.random.default_rng(1).standard_normal((3, STEPS, 1))
SENSOR = Measurement(C, noise=NOISE)
FEEDBACK = LinearFeedback(K, [-1.0], [1.0])


class Exact:
    """An estimator that is told the state itself: y is x."""

    nx, nu, ny = 2, 1, 2

    def start(self, n):
        return Belief(np.zeros((n, 2)), np.zeros((2, 2)))

    def predict(self, belief, u):
        return belief

    def update(self, belief, y, u):
        return Belief(y, belief.covariance)


def run(controller, output=SENSOR, x0=X0, **options):
    w = 0.003 * np.random.default_rng(2).standard_normal((len(x0), STEPS, 2))
    return cc.simulate(MODEL, controller, x0=x0, steps=STEPS, output=output, **({"disturbance": w} | options))


def controllers():
    options = {"Q": np.eye(2), "R": [[0.1]], "horizon": 5, "X": X, "U": U}
    nominal = LinearMPC(A, B, uses=("reference",), **options)
    return {
        "feedback": FEEDBACK,
        "mpc": LinearMPC(A, B, **options),
        "limited mpc": LinearMPC(A, B, rate_limit=[0.2], uses=("reference",), **options),
        "previewing mpc": LinearMPC(A, B, E=np.eye(2), rate_limit=[0.3], uses=("preview",), **options),
        "offset-free mpc": OffsetFreeMPC(nominal, C=np.eye(2)),
        "pid": cc.PID(C, [2.0], [0.5], [1.0], dt=0.1, lower=[-1.0], upper=[1.0]),
        "clock": Clock(),
        "memory of one run": Summing(),
    }


class Clock:
    """u = −K x, faded out over time; it also looks at the output."""

    needs = frozenset({"time", "output"})

    def __call__(self, x, *, time, y):
        return -(x @ K.T) / (1 + 0.1 * time) - 0.01 * y[..., :1]


class Summing:
    """u = −K x − ∫x₁, for one run."""

    def __init__(self):
        self.total = 7.0

    def reset(self):
        self.total = 0.0

    def __call__(self, x):
        assert x.shape == (2,)
        self.total += x[0]
        return -K @ x - 0.01 * self.total


@pytest.mark.parametrize("name", controllers())
def test_told_the_state_itself_every_controller_does_what_it_does_alone(name):
    controller = controllers()[name]
    options = {"output": None, "reference": [0.3, 0.0]}
    alone = run(controller, **options)
    np.testing.assert_allclose(run(Observed(controller, Exact()), **options).states, alone.states, atol=1e-12)


def test_what_the_controller_needs_is_asked_for():
    made = controllers()
    own = {"output", "last_input"}
    assert needs_of(Observed(FEEDBACK, STEADY)) == own
    assert needs_of(Observed(made["limited mpc"], STEADY)) == own | {"reference"}
    assert needs_of(Observed(made["previewing mpc"], STEADY)) == own | {"preview"}
    assert needs_of(Observed(made["offset-free mpc"], STEADY)) == own | {"reference"}
    assert Observed(made["previewing mpc"], STEADY).horizon == 5
    assert not hasattr(Observed(FEEDBACK, STEADY), "horizon")
    with pytest.raises(InputError, match="reference: got nothing"):
        run(Observed(made["limited mpc"], STEADY))
    with pytest.raises(InputError, match="horizon"):
        cc.simulate(MODEL, Observed(made["previewing mpc"], STEADY), x0=X0, steps=3, disturbance=np.zeros((3, 2)),
                    output=C)  # fmt: skip
