"""A verdict turns at the number that its page states: each is tested well below and well above."""

import casadi as ca
import numpy as np
import pytest
from scipy.fft import idct

import ccdtools as cc
from ccdtools import InputError, KalmanFilter, OutputLimits
from ccdtools.controllers import Filtered
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.exceptions import NotDetectableError
from invariant_sets import AdmissibleInputs, Polytope
from learning import ActorCritic, NetworkConfig

NONE = cc.DesignSpace([], [], [])


def plant(after, outputs=None):
    """A plant of one state in steps of a second, x⁺ = after(x, u)."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    measured = None if outputs is None else outputs(x)
    return cc.Plant(x, u, None, None, after(x, u), NONE, 1.0, continuous=False, outputs=measured)


# ── limits and runs ──


@pytest.mark.parametrize(("beyond", "outside"), [(0.3e-9, False), (3e-9, True)])
def test_a_start_a_billionth_beyond_a_limited_output_is_on_the_limit(beyond, outside):
    limits = OutputLimits(lambda x, u, p: x[0], -2.0, 2.0, names=["y"])
    assert limits.broken_at(np.array([2 + 2 * beyond]), 1, np.zeros((1, 0))) == ["y > 2" if outside else ""]


@pytest.mark.parametrize(("part", "text"), [(0.3e-9, "x1 > 1"), (3e-9, "x1 + 3e-09 x2 > 1")])
def test_a_term_of_a_row_below_a_billionth_of_the_largest_is_not_named(part, text):
    X = Polytope([[1.0, part], [-1.0, -part], [0, 1e-6], [0, -1e-6]], [1.0, 1, 1, 1])
    assert cc.excursions([[3.0, 0.0]], X).exceeded == text


@pytest.mark.parametrize(("width", "depth"), [(0.6e-9, 0.5), (6e-9, 1 / 6e-9)])
def test_across_a_set_without_width_half_widths_are_those_of_the_box_around_it(width, depth):
    X = Polytope([[0, 1.0], [0, -1], [1, -1], [-1, 1]], [1, 1, width, width])
    assert cc.depth_outside([1.0, 0.0], X) == pytest.approx(depth, rel=1e-6)


@pytest.mark.parametrize(("start", "moved", "diverged"), [(1.0, 3e5, False), (1.0, 3e6, True), (3e6, 0.0, False)])
def test_without_a_limit_a_run_has_diverged_beyond_a_million_of_its_first_states(start, moved, diverged):
    law = lambda x: np.where(x == start, 0.1, moved)  # noqa: E731
    run = cc.simulate(plant(lambda x, u: x + u), law, x0=[start], steps=2)
    assert run.diverged[0] == diverged


# ── means of one long run ──


@pytest.mark.parametrize(("frequency", "counts"), [(1, True), (4, True), (5, False), (12, False)])
def test_four_frequencies_tell_the_error_of_a_mean(frequency, counts):
    series = idct(np.eye(380)[frequency], norm="ortho")
    error = cc.mean_interval(np.r_[np.zeros(20), series]).std_error  # the first twentieth does not count
    assert error == pytest.approx(counts / np.sqrt(4 * 400), abs=1e-9)


@pytest.mark.parametrize(("length", "counts"), [(6, False), (60, True)])
def test_a_transient_in_the_first_twentieth_is_no_noise(length, counts):
    noise = np.random.default_rng(0).standard_normal(400)
    jumped = noise + 100.0 * (np.arange(400) < length)
    assert (cc.mean_interval(jumped).std_error > 1.01 * cc.mean_interval(noise).std_error) == counts


@pytest.mark.parametrize(("turns", "least", "most"), [(1.09, 0.37, 0.47), (0.96, 0.47, 0.56)])
def test_there_is_an_interval_where_twentieths_are_independent_at_one_per_cent(turns, least, most):
    found = cc.mean_interval(np.r_[np.zeros(20), np.repeat(np.cos(turns * np.arange(20)), 19)])
    assert least < found.correlation < most  # 2.33 / √20 − 1/20 = 0.47 at 1 %, 0.37 at 3 % and 0.56 at 0.3 %
    assert found.reliable == (found.correlation < 0.47)


# ── controllers ──


@pytest.mark.parametrize(("beyond", "changed"), [(0.3e-9, 0), (3e-9, 1)])
def test_an_input_moved_by_less_than_a_billionth_of_its_range_counts_as_unchanged(beyond, changed):
    free = AdmissibleInputs([[0.5]], [[0.1]], Polytope.from_bounds([-9.0], [9.0]), Polytope.from_bounds([-1.0], [1.0]))
    safe = Filtered(lambda x: 0 * x + 1 + 2 * beyond, free)
    safe(np.zeros((1, 1)))
    assert safe.counts.changed == changed


@pytest.mark.parametrize("side", [-1, 1])
def test_a_policy_serves_designs_up_to_a_fortieth_of_the_range_beyond_it(side):
    agent = ActorCritic([-1, 10.0], [1, 30.0], [-1.0], [1.0], config=NetworkConfig((3,)), seed=0)
    assert cc.LearnedPolicy(agent, [20 + side * 10.17]).design[0] == 20 + side * 10.17
    with pytest.raises(InputError, match=r"expected one in \[10, 30\], which the agent was made for"):
        cc.LearnedPolicy(agent, [20 + side * 11.5])


# ── recordings ──


@pytest.mark.parametrize(("part", "accepted"), [(0.3e-3, True), (3e-3, False)])
@pytest.mark.parametrize("moved", ["every step", "one step"])
def test_steps_of_a_recording_may_be_wrong_by_a_thousandth(tmp_path, part, accepted, moved):
    steps = np.where((moved == "every step") | (np.arange(9) == 4), 1 + part, 1.0)
    rows = "\n".join(f"{t!r},0" for t in (0.05 * np.r_[0, np.cumsum(steps)]).tolist())
    (tmp_path / "w.csv").write_text(f"time,w\n{rows}")
    if accepted:
        assert len(cc.read_disturbance(tmp_path / "w.csv", dt=0.05)) == 10
    else:
        with pytest.raises(InputError, match="Resample the file"):
            cc.read_disturbance(tmp_path / "w.csv", dt=0.05)


# ── estimation ──


@pytest.mark.parametrize(("least", "accepted"), [(0.3e-12, False), (3e-12, True)])
def test_a_covariance_is_definite_above_a_trillionth(least, accepted):
    def make():
        return KalmanFilter(0.5 * np.eye(2), np.zeros((2, 1)), np.eye(2), np.eye(2), [[1, 1 - least], [1 - least, 1]])

    if accepted:
        assert make().ny == 2
    else:
        with pytest.raises(InputError, match="V: got"):
            make()


@pytest.mark.parametrize(("constant", "accepted"), [(0.3e-6, True), (3e-6, False)])
def test_a_plant_rests_that_moves_by_less_than_a_millionth_of_a_predicted_deviation(constant, accepted):
    moving = plant(lambda x, u: u + constant, outputs=lambda x: x)  # of predicted variance W
    if accepted:
        assert KalmanFilter.of(moving, W=[1.0], V=[1.0]).nx == 1
    else:
        with pytest.raises(InputError, match="a constant term in the dynamics"):
            KalmanFilter.of(moving, W=[1.0], V=[1.0])


@pytest.mark.parametrize(("part", "named"), [(0.2, (0,)), (0.8, (0, 1))])
def test_states_with_half_of_the_largest_part_of_a_mode_are_named(part, named):
    along, across = np.array([1.0, part]), np.array([-part, 1.0])
    A = (2 * np.outer(along, along) + 0.5 * np.outer(across, across)) / (1 + part**2)
    with pytest.raises(NotDetectableError) as caught:
        KalmanFilter(A, np.zeros((2, 1)), [across], np.eye(2), [[1.0]])
    assert caught.value.states == named


@pytest.mark.parametrize(("start", "words"), [(0.3e-9, "not seen at the first estimate"), (6e-9, "")])
def test_an_output_is_level_where_its_slope_is_below_a_billionth_of_that_nearby(start, words):
    found = CubatureKalmanFilter(plant(lambda x, u: 0.5 * x + 0.1 * ca.sin(x) + u, outputs=lambda x: x**2),
                                 W=[1.0], V=[1.0], P0=[1.0], x0=[start])  # fmt: skip
    assert ("not seen" in repr(found)) == bool(words)
