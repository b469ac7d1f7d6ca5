"""Controllers × designs × scenarios × plants × seeds: rows, columns and names."""

import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, PLANT, WEAK, by_hand, drawn, found, never

from ccdtools import (
    CustomObjective,
    InputError,
    LinearFeedback,
    QuadraticObjective,
    Scenario,
    compare,
    experiment,
    plant_from_matrices,
)
from ccdtools.controllers import Passive
from ccdtools.plants.library import Servo, dc_servo


def test_a_row_for_each_run_of_each_seed():
    rows = found().rows()
    assert len(rows) == 2 * 4 * 7
    assert {(row["controller"], row["seed"], row["run"]) for row in rows} == {
        (name, seed, run) for name in LAWS for seed in range(4) for run in range(7)
    }


def test_returns_are_those_of_the_loop_by_hand_and_gains_are_in_pairs():
    scenario = drawn(np.random.default_rng(5))
    cell = found(WEAK, scenario, seeds=1)["weak"]
    own, base = (by_hand(gain, scenario.x0, scenario.disturbance) for gain in (0.3, GAIN))
    assert cell.value.mean == pytest.approx(own.mean(), rel=1e-12)
    assert cell.evidence.gain.mean == pytest.approx((own - base).mean(), rel=1e-12)
    assert cell.better.mean == pytest.approx((own > base).mean())


def test_what_is_learned_is_learned_anew_for_each_seed_and_design():
    seen = []
    laws = {"LQR": LAWS["LQR"], "learned": lambda design, rng: seen.append(rng.random()) or LinearFeedback([[GAIN]])}
    found(laws, seeds=3)
    assert len(set(seen)) == 3


def test_controllers_of_a_seed_meet_the_same_runs_and_seeds_meet_others():
    twice = {name: lambda design, rng: LinearFeedback([[GAIN]]) for name in ("LQR", "again")}
    rows = found(twice).rows()
    returns = {(row["controller"], row["seed"], row["run"]): row["return"] for row in rows}
    assert all(value == returns["again", seed, run] for (_, seed, run), value in returns.items())
    assert len(set(returns.values())) == 4 * 7


def test_numbers_depend_neither_on_the_order_nor_on_what_else_is_compared():
    rows = found({"learned": LAWS["learned"], "zero": lambda design, rng: Passive(1), "LQR": LAWS["LQR"]}).rows()
    assert [row for row in rows if row["controller"] == "learned"] == [
        row for row in found().rows() if row["controller"] == "learned"
    ]


def test_costs_of_training_and_of_a_step_are_told():
    cell = found()["learned"]
    assert cell.steps == 500
    assert cell.seconds > 0
    assert 0 < cell.step_time[0] <= cell.step_time[1]
    assert "500 samples" in repr(found())


def test_terms_of_the_cost_have_columns_and_add_up_to_the_return():
    x0, w = np.array([[1.0, 0.5], [-2.0, 0.3], [0.2, -1.0]]), np.zeros((3, 7, 0))
    plant = plant_from_matrices([[1.0, 0.1], [-0.2, 0.95]], [[0.0], [0.1]], dt=0.1, continuous=False)
    scenario = Scenario(plant, x0, w)
    laws = {"LQR": lambda design, rng: LinearFeedback([[0.4, 0.3]]), "passive": lambda design, rng: Passive(1)}
    quadratic = QuadraticObjective(np.diag([2.0, 0.5]), [[0.3]], S=[[0.05], [-0.1]])
    custom = CustomObjective(
        lambda x, u, p: 2 * x[0] ** 2 + (x[1] - u[0]) ** 2, lambda x, p: 3 * x[1] ** 2, design_cost=lambda p: 7.0
    )
    for objective in (quadratic, custom):
        given = {"objective": objective, "X": ([-9, -9], [9, 9]), "metrics": objective.terms}
        result = experiment(laws, scenario, seeds=1, **given)
        table = compare({name: make(None, None) for name, make in laws.items()}, scenario, **given)
        for name in laws:
            terms = result[name].metrics
            assert sum(terms.values()) == pytest.approx(-table[name].summary.mean, rel=1e-12)
            assert table.rows()[list(laws).index(name)]["cost of inputs"] == pytest.approx(terms["cost of inputs"])
        assert result["passive"].metrics["cost of inputs"] == 0.0
        assert "cost of states" in repr(result)
    run = scenario.run(laws["LQR"](None, None))
    x, u = run.states, run.inputs[..., 0]
    last = result["LQR"].metrics  # of the custom objective, term by term
    assert last["cost of states"] == pytest.approx((2 * x[:, :-1, 0] ** 2 + x[:, :-1, 1] ** 2).sum(axis=1).mean())
    assert last["cost of inputs"] == pytest.approx((u**2 - 2 * x[:, :-1, 1] * u).sum(axis=1).mean())
    assert last["cost of the end"] == pytest.approx(3 * (x[:, -1, 1] ** 2).mean())
    assert last["cost of the design"] == 7.0


def test_a_plant_is_compared_at_each_parameter_a_share_larger_and_smaller():
    plants = {name: dc_servo(servo=servo) for name, servo in Servo().varied(0.2).items()}
    assert len(plants) == 1 + 2 * len(vars(Servo()))
    nominal = dc_servo()
    x0, w, design = np.array([[0.5, 0.0]]), np.zeros((1, 30, nominal.nw)), nominal.design.centre
    laws = {name: lambda p, rng, gain=gain: LinearFeedback([[gain, 0.1]]) for name, gain in (("a", 1.0), ("b", 2.0))}
    found = experiment(
        laws, Scenario(nominal, x0, w), designs=design, plants=plants, seeds=1,
        objective=QuadraticObjective(np.eye(2), [[0.1]]), X=([-9, -99], [9, 99]),
    )  # fmt: skip
    run = Scenario(dc_servo(servo=Servo(resistance=4.8)), x0, w).run(LinearFeedback([[2.0, 0.1]]), design=design)
    value = float(run.returns(QuadraticObjective(np.eye(2), [[0.1]])).mean())
    assert found["b", "resistance +20 %"].value.mean == pytest.approx(value, rel=1e-12)
    assert found["b", "nominal"].value.mean != found["b", "resistance -20 %"].value.mean
    for share in (0.0, 1.0, "a"):
        with pytest.raises(InputError, match="share: got"):
            Servo().varied(share)


def test_designs_and_metrics_have_columns_of_their_own_and_progress_names_the_design(illustrative, capsys):
    problem = illustrative.problem()
    x0, w = problem.scenarios.sample(5, 10, np.random.default_rng(1))
    laws = {
        "zero": lambda design, rng: Passive(1), "gain": lambda design, rng: LinearFeedback([[design[0] / 20] * 2]),
    }  # fmt: skip
    result = experiment(
        laws,
        Scenario(problem.model, x0, np.array(w)), designs={"low": [1.0], "high": [2.0]}, objective=problem.objective,
        X=problem.X, seeds=2, metrics=lambda run: {"first input": float(run.inputs[0, 0, 0])}, progress=True,
    )  # fmt: skip
    assert "tasks, now gain, high, seed 1: " in capsys.readouterr().err
    text = repr(result)
    assert "design" in text
    assert "first input" in text
    assert len(result) == 4
    assert result["gain", "high"].metrics["first input"] == pytest.approx(-0.1 * x0[0].sum())
    assert result.baseline == "zero"


@pytest.mark.parametrize(("change", "match"), [
    ({"laws": {}}, "controllers: got none"),
    ({"laws": {"LQR": LinearFeedback([[GAIN]])}}, r"controllers\['LQR'\]: got .*takes no \(design, rng\)"),
    ({"laws": {"LQR": 3}}, r"controllers\['LQR'\]: got 3"),
    ({"scenarios": {}}, "scenarios: got none"),
    ({"scenarios": 5}, r"^scenarios: got 5"),
    ({"scenarios": lambda rng: 5}, r"^scenarios: got 5"),
    ({"seeds": [1, 1]}, "seeds: got .*different"),
    ({"seeds": 0}, "seeds"),
    ({"seeds": [-1]}, "seeds"),
    ({"baseline": "MPC"}, "baseline: got 'MPC'"),
    ({"plants": {}}, "plants: got none"),
    ({"plants": {"a": 4}}, r"plants\['a'\]: got 4"),
    ({"scenarios": lambda: 3}, r"^scenarios: got a function that stops with TypeError"),
    ({"scenarios": {"b": lambda rng: rng / 0}}, r"scenarios\['b'\]: got a function that stops with TypeError.*\(line"),
    ({"metrics": lambda run: {"one": 1 / 0}}, "metrics: got a function that stops with ZeroDivisionError"),
    ({"designs": {}}, "designs: got none"),
    ({"designs": [1.0]}, "design"),
    ({"X": ([-1.0, -1.0], [1.0, 1.0])}, r"X\[0\]: got shape"),
    ({"objective": 3}, "objective: got 3"),
    ({"jobs": 0}, "jobs: got 0"),
    ({"metrics": 3}, "metrics: got 3"),
])  # fmt: skip
def test_wrong_arguments_are_named(change, match):
    with pytest.raises(InputError, match=match):
        found(**change)


def test_cells_are_found_by_as_many_names_as_tell_them_apart():
    result = found(scenarios={"a": drawn, "b": drawn}, seeds=1)
    assert result["LQR", "a"].names == ("LQR", "", "a", "")
    with pytest.raises(KeyError, match="2 cells"):
        result["LQR"]


def test_seeds_may_draw_other_numbers_of_runs():
    def some(rng):
        n = int(rng.integers(2, 9))
        return Scenario(PLANT, 2 * rng.standard_normal((n, 1)), rng.standard_normal((n, 15, 1)))

    result = found(scenarios=some, seeds=6)
    returns = {}
    for row in result.rows():
        if row["controller"] == "learned":
            returns.setdefault(row["seed"], []).append(row["return"])
    assert len({len(runs) for runs in returns.values()}) > 1
    assert result["learned"].value.mean == pytest.approx(np.mean([np.mean(runs) for runs in returns.values()]))


def test_a_metric_that_some_seeds_have_not_is_not_averaged_over_the_others():
    laws = {"LQR": LAWS["LQR"]}
    settle = lambda run: {"settled [s]": float("nan") if run.states[0, 0, 0] < 0 else 1.0}  # noqa: E731
    assert np.isnan(found(laws, seeds=6, metrics=settle)["LQR"].metrics["settled [s]"])


def test_names_may_be_told_apart_by_their_order():
    laws = {"LQR": LAWS["LQR"], "B": LAWS["LQR"]}
    result = found(laws, {"LQR": drawn, "B": drawn}, seeds=1)
    assert result["B", "", "LQR"].names == ("B", "", "LQR", "")


def test_the_number_of_runs_is_that_of_the_scenario():
    result = found({"LQR": never, "PID": never}, Scenario(PLANT, np.ones((5, 1)), np.zeros((5, 4, 1))), seeds=3)
    assert "3 seeds, 5 runs of each" in repr(result)
    assert result["PID"].evidence.lost == (15, 15)
