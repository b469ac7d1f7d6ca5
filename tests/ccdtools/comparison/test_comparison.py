"""Every controller on the same disturbances, and what one long run says."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ccdtools import (
    PID,
    CVaR,
    InputError,
    LearnedPolicy,
    LinearFeedback,
    QuadraticObjective,
    Scenario,
    baselines,
    compare,
    experiment,
    load_study,
    plant_from_matrices,
    saturated_lqr,
    simulate,
)
from ccdtools.controllers import History, Observed, Passive
from ccdtools.estimation import KalmanFilter
from invariant_sets import Polytope
from learning import ActorCritic, NetworkConfig
from mpc import LinearMPC

DESIGN = [2.0]


@pytest.fixture(scope="module")
def controllers(illustrative):
    return baselines(illustrative.problem(), DESIGN, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def scenario(illustrative):
    x0, w = illustrative.problem().scenarios.sample(120, 40, np.random.default_rng(1))
    return Scenario(illustrative.model, x0, w)


def compared(study, controllers, scenario, **options):
    problem = study.problem()
    return compare(
        controllers, scenario, design=DESIGN, objective=problem.objective, X=problem.X, limit=problem.limit, **options
    )


def scored(study, controllers, scenario, **options):
    problem = study.problem()
    scores = compare(
        controllers, scenario, design=DESIGN, objective=problem.objective, X=problem.X, limit=problem.limit, **options
    )
    return {score.controller: score for score in scores}


@pytest.fixture(scope="module")
def scores(illustrative, controllers, scenario):
    return scored(illustrative, controllers, scenario)


@pytest.mark.check
def test_the_baselines_are_four(controllers):
    assert list(controllers) == ["passive", "LQR", "PID", "MPC"]
    kinds = [type(c) for c in controllers.values()]
    assert kinds == [Passive, LinearFeedback, PID, LinearMPC]


@pytest.mark.long
def test_every_controller_has_a_score_in_order(scores, controllers):
    assert list(scores) == list(controllers)
    assert scores["LQR"].summary.n == 120
    assert scores["MPC"].summary.n == 100


def test_lqr_differs_from_itself_by_nothing(scores):
    assert scores["LQR"].paired_to_lqr.mean == 0
    assert scores["LQR"].paired_to_lqr.ci95 == (0, 0)


def test_an_unstable_plant_left_alone_diverges_and_is_counted(illustrative, controllers):
    x0, w = illustrative.problem().scenarios.sample(30, 100, np.random.default_rng(1))
    rows = scored(illustrative, controllers, Scenario(illustrative.model, x0, w), few={"MPC": 5})
    passive = rows["passive"]
    assert passive.diverged == 1.0
    assert passive.summary.n == 0
    assert np.isnan(passive.summary.mean)
    assert np.isnan(passive.violations)
    assert np.isnan(passive.paired_to_lqr.mean)
    assert rows["LQR"].diverged == 0
    assert rows["LQR"].summary.n == 30


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("compares", ["compare", "experiment"])
def test_without_a_limit_a_run_is_lost_beyond_a_thousand_half_widths_of_X_in_any_unit(unit, compares):
    plant = plant_from_matrices([[1.5]], [[unit]], [[unit]], dt=1.0, continuous=False)
    run = Scenario(plant, [[unit], [2 * unit]], np.zeros((15, 1)))  # 1.5¹⁵ is 438
    given = {"objective": QuadraticObjective([[1 / unit**2]], [[1.0]]), "X": ([-0.6 * unit], [0.6 * unit])}
    if compares == "compare":
        lost = compare({"LQR": Passive(1)}, run, **given)["LQR"].diverged
    else:
        lost = experiment({"LQR": lambda p, rng: Passive(1)}, run, seeds=1, **given).records[0].cells[0].lost.mean()
    assert lost == 0.5


def test_violations_are_the_fraction_of_states_outside_X(illustrative, controllers, scenario):
    tight = replace(illustrative.problem(), X=illustrative.X)
    X = type(tight.X).from_bounds([-1.0, -1.0], [1.0, 1.0])
    run = simulate(
        scenario.plant, controllers["LQR"], x0=scenario.x0, steps=40, disturbance=scenario.disturbance, design=DESIGN
    )
    (score,) = compare(
        {"LQR": controllers["LQR"]}, scenario, design=DESIGN, objective=tight.objective, X=X, limit=tight.limit
    )
    outside = (np.abs(run.states[:, 1:]) > 1).any(axis=-1).mean()
    assert score.violations == pytest.approx(outside, abs=1e-6)


@pytest.mark.long
def test_the_table_says_how_far_outside_X_and_who_leaves_it_further(illustrative, controllers, scenario):
    problem = illustrative.problem()
    X = type(problem.X).from_bounds([-9.0, -0.3], [9.0, 0.9])
    weak = LinearFeedback(0.3 * controllers["LQR"].K, [-1], [1])
    scenario = Scenario(scenario.plant, [0.0, 0.0], scenario.disturbance)
    table = compare({"LQR": controllers["LQR"], "weak": weak}, scenario, design=DESIGN, objective=problem.objective,
                    X=X, limit=problem.limit)  # fmt: skip
    run = scenario.run(controllers["LQR"], design=DESIGN, limit=problem.limit)
    depth = np.maximum((-0.3 - run.states[:, 1:, 1]) / 0.6, (run.states[:, 1:, 1] - 0.9) / 0.6).clip(0.0)
    assert table["LQR"].depth_mean == pytest.approx(depth.mean())
    assert table["LQR"].depth_peak == pytest.approx(depth.max(axis=1).mean())
    assert table["LQR"].depth_worst == pytest.approx(depth.max())
    assert table["LQR"].exceeded == "x2 < -0.3"
    assert table["weak"].further_outside_than == ("LQR",)
    assert table["LQR"].further_outside_than == ()
    assert table.rows()[1]["further_outside_than"] == "LQR"
    assert {"violations", "depth_mean", "depth_peak", "depth_worst", "exceeded"} <= set(table.to_frame())
    assert "outside X" in repr(table).splitlines()[0]
    assert "<th>depth</th>" in table._repr_html_()


def test_the_depth_of_a_single_long_run_is_paired_as_a_correlated_series(illustrative, controllers):
    problem = illustrative.problem()
    w = problem.scenarios.sample(1, 1000, np.random.default_rng(3))[1]
    X = type(problem.X).from_bounds([-0.2, -0.2], [0.2, 0.2])
    weak = LinearFeedback(0.3 * controllers["LQR"].K, [-1], [1])
    table = compare({"LQR": controllers["LQR"], "weak": weak}, Scenario(illustrative.model, [0.0, 0.0], w),
                    design=DESIGN, objective=problem.objective, X=X, limit=problem.limit)  # fmt: skip
    assert table["weak"].depth_peak == table["weak"].depth_worst
    assert table["weak"].further_outside_than == ("LQR",)


def test_a_baseline_that_is_not_there_is_refused(illustrative, controllers, scenario):
    with pytest.raises(InputError, match=r"baseline: got 'LQR', expected one of passive"):
        scored(illustrative, {"passive": controllers["passive"]}, scenario, baseline="LQR")
    with pytest.raises(InputError, match=r"controllers: got none, expected at least one"):
        scored(illustrative, {}, scenario)


def test_any_controller_is_the_baseline_and_without_lqr_the_first(illustrative, controllers, scenario):
    by_lqr = compared(illustrative, controllers, scenario)
    others = {name: controllers[name] for name in ("passive", "MPC")}
    table = compared(illustrative, others, scenario)
    assert table.baseline == "passive"
    assert "minus passive" in repr(table)
    named = compared(illustrative, controllers, scenario, baseline="passive")
    assert named["LQR"].paired_to_lqr.mean == pytest.approx(-by_lqr["passive"].paired_to_lqr.mean)
    assert "minus_baseline" in named.rows()[0]
    assert "minus_lqr" in by_lqr.rows()[0]


class Model:
    """A model whose predict is like that of Stable-Baselines3: (observation, …, deterministic) → (action, memory)."""

    def __init__(self, law):
        self.law = law

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        return self.law(observation).astype(np.float32), state


def test_a_model_with_predict_is_a_controller(illustrative, controllers, scenario):
    table = scored(illustrative, controllers | {"agent": Model(controllers["LQR"])}, scenario)
    assert table["agent"].summary.mean == pytest.approx(table["LQR"].summary.mean, rel=1e-5)


class Agent(Model):
    """An agent as Stable-Baselines3 hands it over, which knows its spaces."""

    observation_space = action_space = "of an environment"


def test_an_agent_in_units_of_its_environment_is_refused_with_the_cure(illustrative, controllers, scenario):
    agent = Agent(controllers["LQR"])
    with pytest.raises(InputError, match=r"controller: got Agent, .*units of its environment.*env\.controller\(lambda"):
        scored(illustrative, controllers | {"agent": agent}, scenario)
    problem = illustrative.problem()
    options = {"designs": DESIGN, "objective": problem.objective, "X": problem.X, "seeds": 1}
    assert "env.controller(lambda" in experiment({"agent": lambda p, rng: agent}, scenario, **options)["agent"].remark


class Regression:
    """A model as scikit-learn hands it over: predict(rows) → one number a row, where there is one output."""

    def __init__(self, law):
        self.law = law

    def predict(self, rows):
        assert rows.ndim == 2
        return self.law(rows)[:, 0]


def test_a_model_whose_predict_takes_states_alone_is_a_controller(illustrative, controllers, scenario):
    table = scored(illustrative, controllers | {"fitted": Regression(controllers["LQR"])}, scenario)
    assert table["fitted"].summary.mean == pytest.approx(table["LQR"].summary.mean, rel=1e-12)
    with pytest.raises(InputError, match=r"Observed\(controller, estimator\) is one"):
        scored(illustrative, {"LQR": SimpleNamespace(predict=lambda belief, u: belief)}, scenario)


def test_limits_of_a_comparison_may_be_bounds(illustrative, scenario):
    problem = illustrative.problem()
    gains = {"LQR": saturated_lqr(problem, DESIGN)}
    lower, upper = [-0.5, -0.2], [0.4, np.inf]
    known = Polytope([[1, 0], [-1, 0], [0, -1]], [0.4, 0.5, 0.2])
    options = {"design": DESIGN, "objective": problem.objective}
    tables = [compare(gains, scenario, X=X, **options) for X in ((lower, upper), known)]
    assert tables[0]["LQR"].violations == tables[1]["LQR"].violations > 0
    assert tables[0]["LQR"].depth_worst == pytest.approx(tables[1]["LQR"].depth_worst)


# ── the table ──


@pytest.fixture(scope="module")
def table(illustrative, scenario):
    problem = illustrative.problem()
    weak = LinearFeedback([[0.3, 0.3]], [-1], [1])
    gains = {"LQR": saturated_lqr(problem, DESIGN), "weak": weak, "passive": Passive()}
    return compare(gains, scenario, design=DESIGN, objective=problem.objective, X=problem.X, limit=problem.limit)


def test_the_table_is_read_by_number_and_by_name(table):
    assert [score.controller for score in table] == ["LQR", "weak", "passive"]
    assert len(table) == 3
    assert table[0] is table["LQR"]
    with pytest.raises(KeyError, match="the controllers are LQR, weak, passive"):
        table["PID"]


def test_the_rows_hold_what_the_scores_hold(table):
    rows = table.rows()
    assert rows[1]["mean"] == table["weak"].summary.mean
    assert rows[1]["minus_lqr"] == table["weak"].paired_to_lqr.mean
    assert rows[1]["lqr_mean"] == table["LQR"].summary.mean
    frame = table.to_frame()
    assert list(frame["controller"]) == ["LQR", "weak", "passive"]


def test_the_table_prints_and_shows_every_controller(table):
    assert len(repr(table).splitlines()) == 4 + len(table.notes)
    html = table._repr_html_()
    assert html.count("<tr>") == 4
    assert all(name in html for name in ("LQR", "weak", "passive"))


def test_the_picture_shows_each_mean_and_its_interval(table):
    ax = table.plot()
    assert [label.get_text() for label in ax.get_yticklabels()] == ["LQR", "weak", "passive"]
    (container,) = ax.containers
    means = [score.summary.mean for score in table]
    np.testing.assert_allclose(container.lines[0].get_xdata(), means)
    ends = [segment[:, 0] - means[0] for segment in container.lines[2][0].get_segments()]
    np.testing.assert_allclose(ends, [score.paired_to_lqr.ci95 for score in table], atol=1e-9)
    assert table.plot(ax=ax) is ax
    with pytest.raises(InputError, match="ax: got 3, expected matplotlib axes, or None for a new figure"):
        table.plot(ax=3)


def test_the_lqr_stands_beside_a_controller_on_the_runs_that_both_saw(illustrative, controllers, scenario):
    rows = scored(illustrative, {name: controllers[name] for name in ("LQR", "MPC")}, scenario, few={"MPC": 7})
    assert rows["MPC"].lqr_mean == pytest.approx(rows["MPC"].summary.mean - rows["MPC"].paired_to_lqr.mean)
    assert rows["MPC"].lqr_mean != rows["LQR"].summary.mean


# ── time per step ──


def test_a_mean_of_fewer_runs_shares_no_column_with_means_of_all():
    problem = load_study("illustrative").problem()
    law = saturated_lqr(problem, [1.5])
    scenario = Scenario(problem.model, *problem.scenarios.sample(20, 40, np.random.default_rng(0)))
    table = compare({"LQR": law, "MPC": law}, scenario, design=[1.5], objective=problem.objective, X=problem.X,
                    few={"MPC": 2})  # fmt: skip
    returns = scenario.run(law, design=[1.5]).returns(problem.objective)
    lqr, mpc = repr(table).splitlines()[1:3]
    assert f"{returns.mean():.5g}" in lqr
    assert f"{returns[:2].mean():.5g}" not in mpc
    assert table.notes == [f"* MPC: {returns[:2].mean():.5g} on the first 2 of 20 runs, where LQR has "
                           f"{returns[:2].mean():.5g}"]  # fmt: skip
    lines = table.plot().containers
    np.testing.assert_allclose(lines[0].lines[0].get_xdata(), returns.mean())


def test_a_table_says_where_fewer_than_ten_runs_decide_a_risk():
    problem = load_study("illustrative").problem()
    law = saturated_lqr(problem, [1.5])
    scenario = Scenario(problem.model, *problem.scenarios.sample(40, 20, np.random.default_rng(0)))

    def notes(share):
        return compare({"LQR": law}, scenario, design=[1.5], objective=problem.objective, X=problem.X,
                       risk=CVaR(share)).notes  # fmt: skip

    assert notes(0.1) == ["LQR, risk: 4 runs decide it, fewer than 10: no interval"]
    assert notes(0.25) == []


def test_a_pid_without_gains_is_named_and_not_compared_with():
    problem = load_study("illustrative").problem()
    zero = PID([[1.0, 0.0]], [0.0], [0.0], [0.0], dt=0.1, lower=[-1.0], upper=[1.0])
    some = PID([[1.0, 0.0]], [0.1], [0.0], [0.0], dt=0.1, lower=[-1.0], upper=[1.0])
    laws = {"LQR": saturated_lqr(problem, [1.5]), "zero": zero, "some": some}
    scenario = Scenario(problem.model, *problem.scenarios.sample(20, 40, np.random.default_rng(0)))
    table = compare(laws, scenario, design=[1.5], objective=problem.objective, X=problem.X)
    assert "passive" in table["zero"].remark
    assert table["some"].remark == ""
    assert table.notes[-1] == f"zero: {table['zero'].remark}"
    assert table["zero"].paired_to_lqr.mean != 0
    assert "[" not in repr(table).splitlines()[2]


def test_a_controller_that_takes_rows_of_states_alone_is_compared(illustrative, scenario):
    table = compared(illustrative, {"rows": lambda x: -x[:, :1], "none": Passive(1)}, scenario)
    assert table["rows"].step_time > 0


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_exported_law_is_timed_where_there_is_one():
    plant = plant_from_matrices([[1.0, 0.1], [-0.2, 0.95]], [[0.0], [0.1]], dt=0.1, continuous=False)
    agent = ActorCritic([-9, -9], [9, 9], [-1], [1], config=NetworkConfig((16, 16)), imitates=True)
    laws = {"LQR": LinearFeedback([[0.4, 0.3]]), "learned": LearnedPolicy(agent, [])}
    given = {"objective": QuadraticObjective(np.eye(2), [[0.1]]), "X": ([-9, -9], [9, 9])}
    scenario = Scenario(plant, np.ones((3, 2)), np.zeros((3, 7, 0)))
    table = compare(laws, scenario, **given, compiled=True)
    assert np.isnan(table["LQR"].c_step_time)
    assert 0 < table["learned"].c_step_time <= table["learned"].c_step_time_99
    assert table.rows()[1]["c_step_time_us"] == 1e6 * table["learned"].c_step_time
    assert repr(table).splitlines()[0].endswith("in C")
    learned = table["learned"]
    assert f"{1e6 * learned.c_step_time:.3g}, {1e6 * learned.c_step_time_99:.3g}" in repr(table)
    plain = compare(laws, scenario, **given)
    assert np.isnan(plain["learned"].c_step_time)
    assert "in C" not in repr(plain)
    made = {name: lambda design, rng, law=law: law for name, law in laws.items()}
    several = experiment(made, scenario, **given, seeds=2, compiled=True)
    kept = [(one.c_step_time, one.c_step_time_99) for one in several.records][1::2]
    assert several["learned"].c_step_time == tuple(np.median(kept, axis=0))
    assert 0 < several["learned"].c_step_time[0] <= several["learned"].c_step_time[1]
    assert "in C" in repr(several)
    assert "n/a" in repr(several)
    assert "in C" not in repr(experiment(made, scenario, **given, seeds=1))
    with pytest.raises(InputError, match="compiled: got 2"):
        compare(laws, scenario, **given, compiled=2)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_law_with_a_memory_or_a_filter_is_timed_by_its_step_of_outputs():
    plant = plant_from_matrices([[1.0, 0.1], [-0.2, 0.95]], [[0.0], [0.1]], dt=0.1, continuous=False)
    of_states, of_history = (
        LearnedPolicy(ActorCritic([-9] * n, [9] * n, [-1], [1], config=NetworkConfig((8,)), imitates=True), [])
        for n in (2, 6)
    )
    estimator = KalmanFilter([[1.0, 0.1], [-0.2, 0.95]], [[0.0], [0.1]], [[1.0, 0.0]], 0.01 * np.eye(2), [[0.01]])
    laws = {"history": History(of_history, 3), "filter": Observed(of_states, estimator)}
    laws["linear"] = Observed(LinearFeedback([[0.4, 0.3]]), estimator)  # which has no C
    scenario = Scenario(plant, np.ones((3, 2)), np.zeros((3, 7, 0)), output=[[1.0, 0.0]])
    given = {"objective": QuadraticObjective(np.eye(2), [[0.1]]), "X": ([-9, -9], [9, 9]), "baseline": "linear"}
    table = compare(laws, scenario, **given, compiled=True)
    assert table["history"].c_step_time > 0
    assert table["filter"].c_step_time > 0
    assert np.isnan(table["linear"].c_step_time)
