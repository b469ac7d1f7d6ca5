"""A controller is handed what it says it needs, run by run where runs differ, and is never changed."""

from dataclasses import dataclass

import control
import numpy as np
import pytest

from ccdtools import InputError, LinearFeedback, QuadraticObjective, Scenario, compare, simulate
from ccdtools.controllers import Reference
from ccdtools.plants import LinearModel
from invariant_sets import Polytope

A, B, E = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.0], [0.2]]), np.eye(2)
MODEL = LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.2), E=E)
K = np.array([[2.0, 3.0]])


class Listener:
    """Applies −K x and keeps what it was called with."""

    def __init__(self, *needs, horizon=None):
        self.needs = frozenset(needs)
        self.heard = []
        if horizon is not None:
            self.horizon = horizon

    def __call__(self, x, **signals):
        self.heard.append((np.array(x), signals))
        return -x @ K.T


def loop(controller, runs=3, steps=6, **options):
    rng = np.random.default_rng(0)
    w = 0.1 * rng.standard_normal((runs, steps, 2))
    return simulate(MODEL, controller, x0=rng.standard_normal((runs, 2)), steps=steps, disturbance=w, **options)


def test_a_controller_that_needs_nothing_gets_the_state_alone():
    listener = Listener()
    run = loop(listener)
    assert all(signals == {} for _, signals in listener.heard)
    np.testing.assert_array_equal([x for x, _ in listener.heard], run.states[:, :-1].transpose(1, 0, 2))


def test_the_time_is_the_index_of_the_sample():
    listener = Listener("time")
    loop(listener)
    assert [signals["time"] for _, signals in listener.heard] == list(range(6))


def test_the_last_input_is_the_one_applied_and_zero_at_first():
    listener = Listener("last_input")
    run = loop(listener)
    heard = np.array([signals["u_prev"] for _, signals in listener.heard])
    assert not heard[0].any()
    np.testing.assert_array_equal(heard[1:], run.inputs[:, :-1].transpose(1, 0, 2))


def test_the_last_input_is_kept_from_later_changes():
    listener = Listener("last_input")
    loop(listener)
    assert not np.array_equal(listener.heard[1][1]["u_prev"], listener.heard[2][1]["u_prev"])


def test_a_measured_output_is_what_the_matrix_makes_of_the_state():
    C = np.array([[1.0, -2.0]])
    listener = Listener("output")
    run = loop(listener, output=C)
    heard = np.array([signals["y"] for _, signals in listener.heard])
    np.testing.assert_allclose(heard, run.states[:, :-1].transpose(1, 0, 2) @ C.T)
    listener = Listener("output")
    run = loop(listener)
    np.testing.assert_array_equal(listener.heard[-1][1]["y"], run.states[:, -2])


def test_a_reference_comes_row_by_row_and_holds_its_last_row():
    rows = np.arange(8.0).reshape(4, 2)
    listener = Listener("reference")
    loop(listener, reference=rows)
    np.testing.assert_array_equal([s["x_ref"] for _, s in listener.heard], rows[[0, 1, 2, 3, 3, 3]])
    assert "u_ref" not in listener.heard[0][1]


def test_a_controller_with_a_horizon_sees_the_reference_over_it():
    rows = np.arange(8.0).reshape(4, 2)
    listener = Listener("reference", horizon=2)
    loop(listener, reference=Reference(rows, [[1.0], [2.0]]))
    np.testing.assert_array_equal(listener.heard[1][1]["x_ref"], rows[[1, 2, 3]])
    np.testing.assert_array_equal(listener.heard[1][1]["u_ref"], [[2.0], [2.0]])


def test_a_preview_is_that_of_each_run():
    listener = Listener("preview", horizon=3)
    run = loop(listener, runs=2)
    for k in range(6):
        for i in range(2):
            x, signals = listener.heard[2 * k + i]
            np.testing.assert_array_equal(x, run.states[i, k])
            np.testing.assert_array_equal(signals["w"], run.disturbances[i, np.minimum(np.arange(k, k + 3), 5)])


def test_a_preview_that_is_longer_than_the_record_is_refused():
    with pytest.raises(InputError, match="horizon: got 7 samples, which the controller previews, expected at most 6"):
        loop(Listener("preview", horizon=7))
    loop(Listener("preview", horizon=6))
    loop(Listener("reference", horizon=7), reference=[0.0, 0.0])
    scenario = Scenario(MODEL, np.zeros((3, 2)), np.zeros((3, 6, 2)))
    with pytest.raises(InputError, match="horizon"):
        scenario.run(Listener("preview", horizon=7))


def test_without_disturbance_any_preview_is_of_zeros():
    listener = Listener("preview", horizon=7)
    simulate(MODEL, listener, x0=[1.0, 0.0], steps=3)
    assert listener.heard[0][1]["w"].shape == (7, 2)


@pytest.mark.parametrize("runs", [1, 2, 8])
def test_a_preview_sees_what_the_record_holds_beyond_the_simulation(runs):
    listener = Listener("preview", horizon=4)
    w = np.random.default_rng(0).standard_normal((runs, 8, 2))
    simulate(MODEL, listener, x0=[1.0, 0.0], steps=3, disturbance=w)
    np.testing.assert_array_equal(listener.heard[-1][1]["w"], w[-1, 2:6])
    listener = Listener("preview", horizon=4)
    simulate(MODEL, listener, x0=[1.0, 0.0], steps=3, disturbance=w[0])
    np.testing.assert_array_equal(listener.heard[-1][1]["w"], w[0, 2:6])


def test_run_by_run_the_loop_is_the_same_as_batched():
    np.testing.assert_allclose(loop(Listener("preview")).states, loop(Listener()).states, rtol=1e-14, atol=1e-15)


@dataclass
class Integrator:
    """u = −K x − ∫x₁ with a memory for one run."""

    total: float = 0.0

    def reset(self):
        self.total = 0.0

    def __call__(self, x):
        self.total += x[0]
        return -K @ x - 0.01 * self.total


class Integrators:
    """The same for n runs at once."""

    def reset(self, n):
        self.total = np.zeros(n)

    def __call__(self, x):
        self.total = self.total + x[:, 0]
        return -x @ K.T - 0.01 * self.total[:, None]


class Unlearned:
    """The same as a controller that makes one with memory for each loop."""

    def __call__(self, x):
        raise AssertionError("the loop is closed by what `loop` returns")

    def loop(self, n):
        made = Integrators()
        made.reset(n)
        return made


def test_memory_belongs_to_a_run():
    together = loop(Integrators()).states
    np.testing.assert_allclose(loop(Integrator()).states, together, rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(loop(Unlearned()).states, together)


def test_a_controller_with_memory_is_not_changed_and_starts_afresh():
    controller = Integrator(total=5.0)
    first, again = loop(controller).states, loop(controller).states
    np.testing.assert_array_equal(first, again)
    assert controller.total == 5.0


def test_a_reference_that_is_needed_must_be_given():
    with pytest.raises(InputError, match="reference: got nothing, expected a reference, which the controller needs"):
        loop(Listener("reference"))


def test_unknown_needs_are_refused():
    with pytest.raises(InputError, match=r"controller.needs: got .*, expected some of time, reference, preview"):
        loop(Listener("weather"))


def test_a_comparison_hands_over_the_same_signals():
    rows = np.tile([0.5, 0.0], (6, 1))
    scenario = Scenario(MODEL, np.zeros((3, 2)), np.zeros((3, 6, 2)), reference=rows)
    listener = Listener("reference", "last_input")
    table = compare({"LQR": LinearFeedback(K), "listening": listener}, scenario,
                    objective=QuadraticObjective(np.eye(2), [[1.0]]),
                    X=Polytope.from_bounds([-5, -5], [5, 5]))  # fmt: skip
    assert set(listener.heard[0][1]) == {"x_ref", "u_prev"}
    assert table["listening"].step_time > 0
    assert table["listening"].paired_to_lqr.mean == 0
