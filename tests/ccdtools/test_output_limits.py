import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    OutputLimits,
    Plant,
    QuadraticObjective,
    Scenario,
    Study,
    baselines,
    codesign,
    compare,
    discretise,
    simulate,
)
from ccdtools.co_design import expert_dataset
from learning import fit_actor_critic

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 1)
FORCE = p[0] * x[0]
PLANT = Plant(
    x, u, w, p, ca.vertcat(x[1], -FORCE + u + w), DesignSpace(["k"], [0.5], [2.0]), dt=0.1,
    outputs=[FORCE, u - x[1]], output_names=["spring force [N]", "slip [m/s]"],
    output_limits=([-np.inf, -3.0], [0.8, 5.0]),
)  # fmt: skip
MODEL = discretise(PLANT)
OBJECTIVE = QuadraticObjective(np.eye(2), [[0.05]])
LIMITS = OutputLimits.of(PLANT)


def problem(**changes):
    given = {"scenarios": FixedStart([0.5, 0.0], Gaussian([0.05])), "steps": 60, "output_limits": LIMITS}
    return CoDesignProblem(MODEL, ([-2, -3], [2, 3]), ([-4], [4]), OBJECTIVE, **(given | changes))


def test_depths_are_told_in_half_widths_or_in_the_distance_of_a_single_limit():
    z, v = np.array([[1.0, 0.5], [0.2, -2.0]]), np.array([[0.0], [4.0]])
    depths = LIMITS.depths(z, v, np.array([2.0]))
    force, slip = 2.0 * z[:, 0], v[:, 0] - z[:, 1]
    np.testing.assert_allclose(depths, np.stack([(force - 0.8) / 0.8, (slip - 5) / 4, (-3 - slip) / 4], axis=-1))
    tensors = LIMITS.depths(torch.tensor(z), torch.tensor(v), torch.tensor([2.0], dtype=torch.float64))
    np.testing.assert_allclose(tensors, depths)


def test_h_at_most_zero_is_told_in_its_own_unit():
    stress = OutputLimits(lambda x, u, p: ca.fabs(x[0]) / p[0] - 1)
    np.testing.assert_allclose(stress.depths(np.array([3.0, 0.0]), np.zeros(1), np.array([2.0])), [0.5])
    assert stress.row_text(0) == "y1 > 0"


def test_the_exceeded_limit_of_an_output_is_named_and_counted_with_those_of_states():
    scenario = Scenario(MODEL, np.tile([1.5, 0.0], (3, 1)), np.zeros((3, 20, 1)))
    table = compare(
        {"LQR": LinearFeedback([[0.0, 1.0]])}, scenario, design=[1.0], objective=OBJECTIVE,
        X=problem().X, output_limits=LIMITS,
    )  # fmt: skip
    run = scenario.run(LinearFeedback([[0.0, 1.0]]), design=[1.0])
    force = run.states[0, :-1, 0]
    assert table["LQR"].exceeded == "spring force [N] > 0.8"
    assert table["LQR"].depth_peak == pytest.approx((force.max() - 0.8) / 0.8)
    assert table["LQR"].violations == pytest.approx((force > 0.8).mean())


@pytest.mark.check
def test_mpc_keeps_limits_of_the_state_alone():
    """p x₁ ≤ 0.8 is a row of MPC's set; the slip depends on the input and is not."""
    kept = problem().kept_by_mpc(np.array([2.0]))
    assert kept.contains(np.array([0.4 - 1e-9, 1.0]))
    assert not kept.contains(np.array([0.4 + 1e-6, 1.0]))
    assert len(kept.b) == len(problem().X.b) + 1
    mpc = baselines(problem(), [2.0], rng=np.random.default_rng(0))["MPC"]
    run = simulate(MODEL, mpc, x0=[-1.0, 2.9], steps=60, design=[2.0])
    assert 2.0 * run.states[0, :, 0].max() < 0.8 + 1e-6


def test_a_limit_that_has_no_slope_at_rest_is_none_of_mpcs():
    steep = OutputLimits(lambda x, u, p: [ca.sqrt(x[0]) - 5, ca.log(x[1]), p[0] * x[0]], upper=[0.0, 0.0, 0.8])
    kept = problem(output_limits=steep).kept_by_mpc(np.array([2.0]))
    np.testing.assert_allclose(kept.A[-1] / kept.b[-1], [2.5, 0.0])
    assert len(kept.b) == len(problem().X.b) + 1


def test_copies_of_limits_are_limits():
    twin = pickle.loads(pickle.dumps(problem()))
    z, v, q = np.ones((4, 2)), np.ones((4, 1)), np.array([1.0])
    np.testing.assert_array_equal(twin.output_limits.depths(z, v, q), LIMITS.depths(z, v, q))


@pytest.mark.check
def test_a_codesign_keeps_a_limit_of_an_output_that_binds():
    """The return alone asks for a soft spring; but only one of k ≥ 1 takes the deflection of 0.6 at the start."""
    config = CoDesignConfig(iterations=80, starts=1, pathwise_runs=16, evaluation_runs=32)
    rng = np.random.default_rng(0)
    free = problem(output_limits=None, scenarios=FixedStart([0.6, 0.0], Gaussian([0.05])), steps=30)
    data = expert_dataset(free, samples=100, rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, rng=rng, action_bounds=free.input_bounds,
        input_bounds=free.observation_bounds,
    )  # fmt: skip
    limited = replace(free, output_limits=OutputLimits(lambda x, u, p: x[0] / (0.6 * p[0]) - 1),
                      limit_tolerance=(0.002, 0.002))  # fmt: skip
    found = [codesign(one, agent=agent, design=[1.0], rng=np.random.default_rng(1), config=config)
             for one in (free, limited)]  # fmt: skip
    stiffness = [float(one.design[0]) for one in found]
    assert stiffness[0] < 0.9
    assert 0.99 < stiffness[1] < 1.1
    assert found[1].limits.kept


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OutputLimits(3.0), "output_limits: got 3.0"),
        (lambda: OutputLimits(lambda x, u, p: x, [0, 0], [1, 1, 1]), "as many on either side"),
        (lambda: OutputLimits(lambda x, u, p: x, 1.0, 0.0), "lower < upper"),
        (lambda: OutputLimits(lambda x, u, p: x, -np.inf, np.inf), "at least one finite limit"),
        (lambda: problem(output_limits=OutputLimits(lambda x, u, p: x, upper=[1.0, 1.0, 1.0])), "2, one per output"),
        (lambda: problem(output_limits=OutputLimits(lambda x, u, p: x, names=["a"])), "names"),
        (lambda: problem(output_limits=(0, 1)), "output_limits"),
        (lambda: problem(output_limits=OutputLimits(lambda x, u, p: [])), "without a value"),
    ],
)
def test_wrong_limits_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


# ── starts that break a limit ──


def test_a_start_that_breaks_a_limit_of_an_output_at_every_design_is_refused():
    """The spring force at x = 1.7 is 0.85 N at the softest spring."""
    with pytest.raises(InputError, match=r"scenarios.x0: got \[1.7, 0.0\], where spring force \[N\] > 0.8 whatever"):
        problem(scenarios=FixedStart([1.7, 0.0], Gaussian([0.05])))
    edge = problem(scenarios=FixedStart([1.6, 0.0], Gaussian([0.05])))
    found = edge.output_limits.broken_at(np.array([1.6, 0.0]), 1, np.array([[0.5], [0.6]]))
    assert found == ["", "spring force [N] > 0.8"]


def test_a_limit_that_the_input_acts_on_refuses_no_start():
    limits = OutputLimits(lambda x, u, p: u[0] - x[1], -3.0, 5.0)
    assert limits.broken_at(np.array([0.0, 9.0]), 1, np.array([[0.5]])) == [""]


def test_a_study_names_its_own_start():
    given = {"name": "spring", "title": "Spring", "plant": PLANT, "X": ([-3, -3], [3, 3]), "U": ([-2], [2]),
             "objective": OBJECTIVE, "disturbance": Gaussian([0.05]), "p0": [1.0]}  # fmt: skip
    with pytest.raises(InputError, match=r"^x0: got \[1.7, 0.0\], where spring force \[N\] > 0.8"):
        Study(**given, x0=[1.7, 0.0])
