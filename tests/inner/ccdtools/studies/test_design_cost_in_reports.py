"""What a report calls equal, and its per cent, are of what control makes, whatever every design costs."""

import numpy as np
import pytest

from ccdtools import FixedStart, Gaussian, LinearFeedback, QuadraticObjective, Scenario, compare, discretise
from ccdtools.studies.report.gains import console_lines, gain_percent
from ccdtools.studies.report.headline import _cost
from ccdtools.studies.report.verdicts import percent_of_reference, verdict


def row(cost, *, gain, design_cost):
    """A row on the real plant."""
    return {"controller": "learned", "generation": 1, "plant": "real", "mean": -cost, "lqr_mean": -cost - gain,
            "paired_to_lqr": {"mean": gain, "ci95": [gain - 0.01, gain + 0.01]}, "n": 50, "diverged": 0.0,
            "design_cost": design_cost}  # fmt: skip


@pytest.mark.parametrize("constant", [0.0, 1e4])
def test_verdicts_and_percentages_leave_the_cost_of_the_design_out(constant):
    one = row(9.8 + constant, gain=0.2, design_cost=constant)
    assert verdict(one, {**one, "controller": "LQR"}) == "better"
    assert percent_of_reference(one, one) == pytest.approx((2.0, 1.9, 2.1))
    place = {"start": -10.0 - constant, "design_cost": constant, "total": {"mean": 1.0, "ci95": [0.5, 1.5]}}
    assert gain_percent(place, "total") == pytest.approx((10.0, 5.0, 15.0))


def test_the_headline_says_what_its_per_cent_are_of():
    def results(constant):
        """Costs of 10 before and 9 after, beside that of the design."""
        rows = [(0, "LQR", 10.0), (1, "LQR", 9.5), (1, "learned", 9.0)]
        return {"comparison": [row(cost + constant, gain=0.0, design_cost=constant)
                               | {"generation": g, "controller": name} for g, name, cost in rows]}  # fmt: skip

    plain, dear = (_cost(results(constant), 1) for constant in (0.0, 1000.0))
    assert plain == "real plant: cost −10 % (10 → 9), −5 % from the design and −5 % from the policy"
    assert dear == (
        "real plant: cost −10 % of what control costs (1010 → 1009), −5 % from the design and −5 % from the policy"
    )


def test_a_score_knows_what_its_returns_hold_for_the_design(illustrative):
    objective = QuadraticObjective(illustrative.objective.Q, illustrative.objective.R, design_cost=lambda p: 7 * p[0])
    x0, w = FixedStart([1.0, 0.0], Gaussian([0.1, 0.1])).sample(5, 20, np.random.default_rng(0))
    (score,) = compare(
        {"LQR": LinearFeedback(np.zeros((1, 2)), [-1], [1])}, Scenario(discretise(illustrative.plant), x0, w),
        design=[2.0], objective=objective, X=illustrative.X,
    )  # fmt: skip
    assert score.design_cost == pytest.approx(14.0)


def test_the_gains_say_what_their_per_cent_are_of():
    gain = {"mean": 1.0, "ci95": [0.5, 1.5]}
    sources = dict.fromkeys(("design", "policy", "updates", "redesign", "total"), gain)
    place = {"place": "real plant", "runs": 9, "steps": 5, "left_out": 0.0, "start": -20.0, "design_cost": 10.0}
    served = {"place": "as deployed, model", "runs": 9, "steps": 5, "left_out": 0.0, "design_costs": [10.0, 14.0],
              "means": [-20.0, -19.0, -18.0], "changes": [gain, gain]}  # fmt: skip
    first, second, _, title, row = console_lines({"gains": [place | sources], "in_service": [served]})
    assert "of what control costs LQR at the start design" in first
    assert "total +10 %" in second
    assert title.startswith("in service at the start and after each generation")
    assert row == "  as deployed, model (9 runs of 5 steps): −20.00; −19.00, +10 % [+5, +15]; −18.00, +20 % [+10, +30]"
