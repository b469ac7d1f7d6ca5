"""Verdicts of an experiment, and runs that are lost."""

import re

import numpy as np
import pytest
from scalar_experiment import GAIN, LAWS, OBJECTIVE, PLANT, WILD, always, drawn, found, never

from ccdtools import InputError, LinearFeedback, QuadraticObjective, Scenario, compare, experiment, plant_from_matrices
from ccdtools.controllers import Passive


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
    result = found({"LQR": never, "learned": LAWS["learned"]})
    assert result.verdicts["learned", ""].startswith("open")


def test_lost_runs_are_told_as_a_part_of_all_where_no_controller_can_be_made():
    bold = {"LQR": LAWS["LQR"], "never": never, "bold": lambda design, rng: LinearFeedback([[GAIN + 1.4]])}
    shares = {}
    for baseline in ("LQR", "never"):
        result = found(bold, WILD, seeds=3, limit=[5.0], baseline=baseline)
        for name in bold:
            lost, runs = result[name].evidence.lost[0], result[name].evidence.runs
            shares[baseline, name] = lost / runs
    assert shares["LQR", "never"] == shares["never", "never"] == 1.0
    assert shares["LQR", "bold"] == shares["never", "bold"] == 0.5


def test_lost_runs_count_against_a_controller_whatever_it_gains():
    bold = {"LQR": lambda design, rng: Passive(1), "bold": lambda design, rng: LinearFeedback([[GAIN + 1.4]])}
    cell = found(bold, WILD, seeds=1, limit=[5.0])["bold"]
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


def test_a_gain_too_small_to_matter_is_equal_whatever_its_interval():
    laws = {"LQR": LAWS["LQR"], "hardly": lambda design, rng: LinearFeedback([[GAIN * 0.999]])}
    cell = found(laws, seeds=12)["hardly"]
    low, high = cell.evidence.gain.ci95
    assert not low <= 0 <= high
    assert cell.word == "equal"


def test_a_seed_that_loses_a_run_is_the_worst_of_the_middle_half():
    def bold(design, rng):
        made.append(0)
        return LinearFeedback([[GAIN if len(made) % 4 else GAIN + 2.0]])

    made = []
    lost = found({"LQR": LAWS["LQR"], "bold": bold}, drawn(np.random.default_rng(5)), seeds=4, limit=[60.0])["bold"]
    assert lost.evidence.lost[0] > 0
    kept = found(seeds=4, scenarios=drawn(np.random.default_rng(5)))["LQR"]
    assert lost.middle.mean == pytest.approx(kept.middle.mean)  # one of four is trimmed, and three are alike


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


def test_a_baseline_that_does_nothing_is_named():
    start = Scenario(PLANT, np.ones((5, 1)), np.zeros((5, 4, 1)))
    laws = {"LQR": LinearFeedback([[0.0]]), "B": LinearFeedback([[GAIN]])}
    said = "LQR: does nothing on the scenario: all its inputs were 0"
    assert said in repr(found(always(laws), start, seeds=2))
    assert said in repr(compare(laws, start, objective=OBJECTIVE, X=([-50], [50])))
    assert "does nothing" not in repr(compare(laws, start, objective=OBJECTIVE, X=([-50], [50]), baseline="B"))
    assert "does nothing" not in repr(found(always(laws), start, seeds=2, baseline="B"))


def test_a_single_run_that_is_lost_leaves_a_row_in_both_tables():
    drive = Scenario(plant_from_matrices([[2.0]], [[1.0]], [[1.0]], dt=1.0, continuous=False), [1.0], np.ones((60, 1)))
    laws = {"LQR": LinearFeedback([[1.5]]), "none": Passive(1)}
    given = {"objective": OBJECTIVE, "X": ([-5.0], [5.0])}
    assert compare(laws, drive, **given)["none"].diverged == 1.0
    assert experiment(always(laws), drive, seeds=1, **given)["none"].word == "loses more runs"
