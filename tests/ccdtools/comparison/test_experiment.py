"""Controllers × designs × scenarios × plants × seeds: rows, pairs and verdicts."""

import re

import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, OBJECTIVE, PLANT, by_hand, drawn, found
from scipy.stats import binomtest

from ccdtools import (
    CustomObjective,
    InputError,
    LinearFeedback,
    Measurement,
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


def test_the_table_has_the_interval_of_the_share_of_runs_that_are_better():
    result = found()
    cell = result["learned"]
    low, high = cell.better.ci95
    assert 0.0 <= low <= cell.better.mean <= high <= 1.0
    assert f" {100 * cell.better.mean:.0f} % [{100 * low:.0f}, {100 * high:.0f}] " in repr(result)


def test_returns_are_those_of_the_loop_by_hand_and_gains_are_in_pairs():
    scenario = drawn(np.random.default_rng(5))
    cell = found({"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.3]])}, scenario, seeds=1)["weak"]
    own, base = (by_hand(gain, scenario.x0, scenario.disturbance) for gain in (0.3, GAIN))
    assert cell.value.mean == pytest.approx(own.mean(), rel=1e-12)
    assert cell.evidence.gain.mean == pytest.approx((own - base).mean(), rel=1e-12)
    assert cell.better.mean == pytest.approx((own > base).mean())


def test_one_seed_on_one_scenario_says_what_compare_says():
    scenario = drawn(np.random.default_rng(5))
    laws = {"LQR": LinearFeedback([[GAIN]]), "weak": LinearFeedback([[0.3]])}
    cell = found({name: lambda design, rng, law=law: law for name, law in laws.items()}, scenario, seeds=1)["weak"]
    score = compare(laws, scenario, objective=OBJECTIVE, X=([-50.0], [50.0]))["weak"]
    assert cell.evidence.gain.ci95 == pytest.approx(score.paired_to_lqr.ci95)
    assert cell.value.ci95 == pytest.approx(score.summary.ci95)


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


def test_a_controller_that_cannot_be_made_says_so_and_others_go_on():
    def some(design, rng):
        raise InputError("gains", "none", "a stable loop")

    result = found(LAWS | {"PID": some})
    assert "got none" in result["PID"].remark
    assert np.isnan(result["PID"].value.mean)
    assert result.verdicts["PID", ""].startswith("stopped")
    assert result["PID"].evidence.lost == (28, 0)
    assert np.isfinite(result["learned"].value.mean)
    assert "PID: seed 0: " in repr(result)


def test_a_controller_that_fails_for_one_seed_is_not_better_by_the_others():
    def lucky(design, rng):
        if rng.random() < 0.5:
            raise InputError("seed", "a bad one", "a good one")
        return LinearFeedback([[GAIN]])

    result = found({"LQR": lambda design, rng: Passive(1), "lucky": lucky}, seeds=8)
    assert 0 < result["lucky"].seeds < 8
    assert result["lucky"].evidence.gain.mean > 0
    assert result.verdicts["lucky", ""].startswith("stopped")


def test_a_baseline_that_could_not_be_found_has_no_verdict():
    result = found(LAWS | {"PID": lambda design, rng: Passive(1, remark="no gains were found")})
    assert result.verdicts["PID", ""].startswith("none")
    assert "PID: no gains were found" in repr(result)


def test_a_missing_baseline_lets_nothing_be_better():
    def never(design, rng):
        raise InputError("gains", "none", "some")

    result = found({"LQR": never, "learned": LAWS["learned"]})
    assert result.verdicts["learned", ""].startswith("open")


def test_lost_runs_are_told_as_a_part_of_all_where_no_controller_can_be_made():
    def never(design, rng):
        raise InputError("gains", "none", "some")

    bold = {"LQR": LAWS["LQR"], "never": never, "bold": lambda design, rng: LinearFeedback([[GAIN + 1.4]])}
    wild = Scenario(PLANT, [[0.1], [5.0]], np.zeros((2, 15, 1)))
    shares = {}
    for baseline in ("LQR", "never"):
        result = found(bold, wild, seeds=3, limit=[5.0], baseline=baseline)
        for name in bold:
            lost, runs = result[name].evidence.lost[0], result[name].evidence.runs
            shares[baseline, name] = lost / runs
    assert shares["LQR", "never"] == shares["never", "never"] == 1.0
    assert shares["LQR", "bold"] == shares["never", "bold"] == 0.5


def test_lost_runs_count_against_a_controller_whatever_it_gains():
    bold = {"LQR": lambda design, rng: Passive(1), "bold": lambda design, rng: LinearFeedback([[GAIN + 1.4]])}
    wild = Scenario(PLANT, [[0.1], [5.0]], np.zeros((2, 15, 1)))
    cell = found(bold, wild, seeds=1, limit=[5.0])["bold"]
    assert cell.evidence.lost[0] > cell.evidence.lost[1]
    assert cell.word == "loses more runs"


def test_leaving_the_limits_further_is_no_gain():
    def tight(rng):
        return Scenario(PLANT, 2 * rng.standard_normal((40, 1)), rng.standard_normal((40, 15, 1)))

    cheap = QuadraticObjective(Q=[[0.01]], R=[[1.0]])
    laws = {"LQR": LAWS["LQR"], "lazy": lambda design, rng: LinearFeedback([[0.1]])}
    result = found(laws, tight, objective=cheap, X=([-2.0], [2.0]))
    assert result["lazy"].evidence.gain.ci95[0] > 0
    assert result["lazy"].word == "better in return only"


def test_one_verdict_stands_on_all_scenarios_and_plants():
    other = plant_from_matrices([[0.2]], [[1.0]], [[1.0]], dt=1.0, continuous=False)
    laws = {"LQR": lambda design, rng: LinearFeedback([[0.1]]), "strong": lambda design, rng: LinearFeedback([[0.5]])}
    result = found(laws, plants={"nominal": PLANT, "other": other}, seeds=10)
    assert result["strong", "nominal"].word == "better"
    assert result["strong", "other"].word == "worse"
    assert re.fullmatch("worse: −.* on other, better on 1 of 2", result.verdicts["strong", ""])


def test_the_interval_holds_chance_of_training_and_of_runs():
    """With the same runs for all seeds a deterministic controller has the interval of its runs."""
    scenario = drawn(np.random.default_rng(5))
    laws = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.3]])}
    cell = found(laws, scenario, seeds=6)["weak"]
    alone = found(laws, scenario, seeds=1)["weak"]
    assert cell.evidence.gain.ci95 == pytest.approx(alone.evidence.gain.ci95)
    varied = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.2 + 0.2 * rng.random()]])}
    result = found(varied, scenario, seeds=6)
    low, high = result["weak"].evidence.gain.ci95
    rows = result.rows()
    weak = [[row["return"] for row in rows if (row["controller"], row["seed"]) == ("weak", k)] for k in range(6)]
    means = np.mean(weak, axis=1)
    assert (high - low) / 2 > 2 * np.std(means, ddof=1) / np.sqrt(6)


def test_few_seeds_are_said_to_be_too_few_for_their_intervals():
    assert "9 seeds are too few for 95 % where returns are skewed: take 10 or more." in repr(found(seeds=9))
    assert "too few" not in repr(found(seeds=10))


def test_the_interquartile_mean_does_not_follow_one_bad_seed():
    def unlucky(design, rng):
        return LinearFeedback([[GAIN if made.append(0) or len(made) != 3 else -0.09]])

    made = []
    cell = found({"LQR": LAWS["LQR"], "unlucky": unlucky}, drawn(np.random.default_rng(5)), seeds=8)["unlucky"]
    base = found(seeds=8, scenarios=drawn(np.random.default_rng(5)))["LQR"]
    assert cell.middle.mean == pytest.approx(base.value.mean)
    assert cell.value.mean < base.value.mean - 1


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


def test_a_gain_too_small_to_matter_is_equal_whatever_its_interval():
    laws = {"LQR": LAWS["LQR"], "hardly": lambda design, rng: LinearFeedback([[GAIN * 0.999]])}
    cell = found(laws, seeds=12)["hardly"]
    low, high = cell.evidence.gain.ci95
    assert not low <= 0 <= high
    assert cell.word == "equal"


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


def test_a_seed_that_loses_a_run_is_the_worst_of_the_middle_half():
    def bold(design, rng):
        made.append(0)
        return LinearFeedback([[GAIN if len(made) % 4 else GAIN + 2.0]])

    made = []
    lost = found({"LQR": LAWS["LQR"], "bold": bold}, drawn(np.random.default_rng(5)), seeds=4, limit=[60.0])["bold"]
    assert lost.evidence.lost[0] > 0
    kept = found(seeds=4, scenarios=drawn(np.random.default_rng(5)))["LQR"]
    assert lost.middle.mean == pytest.approx(kept.middle.mean)  # one of four is trimmed, and three are alike


def test_a_drive_that_is_lost_with_one_seed_leaves_the_others_their_interval():
    drive = Scenario(PLANT, [[1.0]], np.random.default_rng(3).standard_normal((400, 1)))
    made = []

    def base(design, rng):
        made.append(0)
        return LinearFeedback([[GAIN if len(made) != 2 else -2.0]])

    same = {"LQR": base, "B": LAWS["LQR"]}
    cell = found(same, drive, seeds=4, limit=[1e4])["B"]
    assert cell.evidence.lost == (0, 1)
    assert cell.evidence.gain.ci95 == (0.0, 0.0)
    clean = found({"LQR": LAWS["LQR"]}, drive, seeds=4)["LQR"]
    assert cell.value.ci95 == pytest.approx(clean.value.ci95)


def test_one_drawn_run_has_no_interval():
    def start(rng):
        return Scenario(PLANT, rng.standard_normal((1, 1)), np.zeros((15, 1)))

    laws = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.3]])}
    cell = found(laws, start, seeds=1)["weak"]
    assert np.isnan(cell.evidence.gain.ci95).all()
    assert cell.word == "open"


def test_one_run_whose_measurement_is_noisy_has_the_interval_that_compare_gives_it():
    class FromOutput:
        needs = frozenset({"output"})

        def __init__(self, gain):
            self.gain = gain

        def __call__(self, x, y):
            return -self.gain * y

    noise = 0.3 * np.random.default_rng(0).standard_normal((1, 200, 1))
    run = Scenario(PLANT, [[0.0]], np.zeros((1, 200, 1)), output=Measurement([[1.0]], noise=noise))
    cell = found({"LQR": lambda p, rng: FromOutput(0.5), "weak": lambda p, rng: FromOutput(0.4)}, run, seeds=3)["weak"]
    both = compare({"LQR": FromOutput(0.5), "weak": FromOutput(0.4)}, run, objective=OBJECTIVE, X=(-50, 50))
    low, high = cell.evidence.gain.ci95
    assert low < cell.evidence.gain.mean < high
    assert (low, high) == pytest.approx(both["weak"].paired_to_lqr.ci95)


def test_a_function_that_always_returns_the_same_runs_is_taken_as_these_runs():
    scenario = drawn(np.random.default_rng(5))
    laws = {"LQR": LAWS["LQR"], "weak": lambda design, rng: LinearFeedback([[0.3]])}
    one, other = (found(laws, given, seeds=5)["weak"].evidence.gain for given in (scenario, lambda rng: scenario))
    assert one.ci95 == pytest.approx(other.ci95)


def test_two_that_cannot_be_made_for_the_same_seeds_lose_as_many_runs():
    def second_fails(gain):
        calls = []

        def made(design, rng):
            calls.append(0)
            if len(calls) == 2:
                raise InputError("gain", "none", "one")
            return LinearFeedback([[gain]])

        return made

    cell = found({"LQR": second_fails(0.3), "B": second_fails(GAIN)}, seeds=5)["B"]
    assert cell.evidence.lost == (7, 7)
    assert cell.word == "better"


def test_a_metric_that_some_seeds_have_not_is_not_averaged_over_the_others():
    laws = {"LQR": LAWS["LQR"]}
    settle = lambda run: {"settled [s]": float("nan") if run.states[0, 0, 0] < 0 else 1.0}  # noqa: E731
    assert np.isnan(found(laws, seeds=6, metrics=settle)["LQR"].metrics["settled [s]"])


def test_names_may_be_told_apart_by_their_order():
    laws = {"LQR": LAWS["LQR"], "B": LAWS["LQR"]}
    result = found(laws, {"LQR": drawn, "B": drawn}, seeds=1)
    assert result["B", "", "LQR"].names == ("B", "", "LQR", "")


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_a_return_that_is_no_number_leaves_no_verdict(value):
    class Undefined(QuadraticObjective):
        def rewards(self, x_next, u, x=None, p=None):
            return np.where(x_next[..., 0] > 3.5, value, super().rewards(x_next, u, x, p))

    start = Scenario(PLANT, np.linspace(0, 5, 9)[:, None], np.zeros((9, 20, 1)))
    laws = {"LQR": LAWS["LQR"], "none": lambda p, rng: Passive(1)}
    result = found(laws, {"far": start, "near": drawn}, objective=Undefined([[1.0]], [[1.0]]), seeds=2)
    cell = result["none", "far"]
    assert (cell.word, cell.evidence.lost) == ("open", (0, 0))
    assert np.isnan([cell.value.mean, cell.evidence.gain.mean, cell.better.mean]).all()
    assert f"seed 0: far: run 7 has the return {value}" in cell.remark
    assert result["LQR", "far"].remark == ""
    assert result.verdicts["none", ""].startswith(("open: n/a on far", "worse: "))


def test_the_number_of_runs_is_that_of_the_scenario():
    def never(design, rng):
        raise InputError("gains", "none", "some")

    result = found({"LQR": never, "PID": never}, Scenario(PLANT, np.ones((5, 1)), np.zeros((5, 4, 1))), seeds=3)
    assert "3 seeds, 5 runs of each" in repr(result)
    assert result["PID"].evidence.lost == (15, 15)


def test_a_baseline_that_does_nothing_is_named():
    start = Scenario(PLANT, np.ones((5, 1)), np.zeros((5, 4, 1)))
    laws = {"LQR": LinearFeedback([[0.0]]), "B": LinearFeedback([[GAIN]])}
    made = {name: lambda p, rng, law=law: law for name, law in laws.items()}
    said = "LQR: does nothing on the scenario: all its inputs were 0"
    assert said in repr(found(made, start, seeds=2))
    assert said in repr(compare(laws, start, objective=OBJECTIVE, X=([-50], [50])))
    assert "does nothing" not in repr(compare(laws, start, objective=OBJECTIVE, X=([-50], [50]), baseline="B"))
    assert "does nothing" not in repr(found(made, start, seeds=2, baseline="B"))


@pytest.mark.parametrize("seeds", [1, 3, 12])
@pytest.mark.parametrize("fresh", [True, False])
def test_a_share_of_all_runs_or_of_none_has_an_interval(seeds, fresh):
    """There it is that of Clopper and Pearson: of the runs of one seed, of fresh seeds, or of the fewer of both."""
    laws = {"LQR": LAWS["LQR"], "wild": lambda p, rng: lambda x: -9.0 * np.ones((len(x), 1))}
    for (one, other), at in ((laws, 0), (reversed(laws), 1)):
        start = drawn if fresh else drawn(np.random.default_rng(5))
        better = found(laws, start, seeds=seeds, baseline=one)[other].better
        n = 7 if seeds == 1 else seeds if fresh else min(seeds, 7)
        assert better.mean == at
        expected = binomtest(at * n, n).proportion_ci()
        assert better.ci95 == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_share_of_the_runs_of_one_seed_has_the_exact_interval():
    better = found({"LQR": LAWS["LQR"], "weak": lambda p, rng: LinearFeedback([[0.3]])}, seeds=1)["weak"].better
    won = round(7 * better.mean)
    expected = binomtest(won, 7).proportion_ci()
    assert 0 < won < 7
    assert better.ci95 == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_single_run_that_is_lost_leaves_a_row_in_both_tables():
    drive = Scenario(plant_from_matrices([[2.0]], [[1.0]], [[1.0]], dt=1.0, continuous=False), [1.0], np.ones((60, 1)))
    laws = {"LQR": LinearFeedback([[1.5]]), "none": Passive(1)}
    given = {"objective": OBJECTIVE, "X": ([-5.0], [5.0])}
    assert compare(laws, drive, **given)["none"].diverged == 1.0
    made = {name: lambda p, rng, law=law: law for name, law in laws.items()}
    assert experiment(made, drive, seeds=1, **given)["none"].word == "loses more runs"
