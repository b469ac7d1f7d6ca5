"""What the report says in words and numbers: verdicts, notes, headline, digits; of results made up for it."""

import pytest

from ccdtools.co_design.result import CoDesignStatus
from ccdtools.evidence.drift import DriftStatus
from ccdtools.evidence.percent import number, percent_interval, share, signed_percent, with_minus
from ccdtools.studies.report.gains import held_out_rows
from ccdtools.studies.report.headline import headline
from ccdtools.studies.report.summary import next_steps
from ccdtools.studies.report.tables import metric_table
from ccdtools.studies.report.verdicts import limit_notes, verdict


@pytest.mark.parametrize(
    ("value", "text"),
    [(-73.1234, "-73.12"), (None, "n/a"), (0.0, "0"), (1e4, "10000"), (3.1e-5, "3.100·10⁻⁵"), (9.9999, "10.00")],
)
def test_numbers_have_four_digits(value, text):
    assert number(value) == text


def test_fractions_are_shown_in_per_cent():
    assert share(0.000667) == "0.07 %"
    assert share(1e-6) == "< 0.01 %"
    assert share(0.0) == "0 %"
    assert share(None) == "n/a"


@pytest.mark.parametrize(
    ("percent", "text"), [(-0.000815, "0 %"), (0.344, "+0.34 %"), (-12.34, "−12 %"), (5.0, "+5 %")]
)
def test_changes_are_shown_without_false_digits(percent, text):
    assert signed_percent(percent) == text


def test_minus_signs_stand_before_numbers_alone():
    assert with_minus("MPC, offset-free: mean -131.3 [-inf, -.5]") == "MPC, offset-free: mean −131.3 [−inf, −.5]"


@pytest.mark.parametrize(
    ("ends", "expected"),
    [((0.6, 0.8), "better"), ((0.01, 1.2), "better"), ((0.1, 0.2), "equal"), ((-0.4, 0.2), "equal"),
     ((0.01, 0.7), "not worse"), ((-0.4, 0.9), "not worse"), ((-0.7, 0.1), "open"), ((-0.6, -0.2), "open"),
     ((-0.9, -0.6), "worse"), ((None, None), "no pairs"), ((1e-13, 3e-13), "equal"), ((0.0, 0.0), "equal"),
     ((-2.0, -1e-9), "open"), ((-2.0, -3e-5), "open"), ((-2.0, -3e-4), "worse"),
     ((3e-5, 2.0), "not worse"), ((3e-4, 2.0), "better")],
)  # fmt: skip
def test_verdict_takes_what_is_certain_and_matters(ends, expected):
    low, high = ends
    gain = None if low is None else (low + high) / 2
    mean = None if gain is None else -100.0 + gain
    row = {"paired_to_lqr": {"mean": gain, "ci95": [low, high]}, "mean": mean, "n": 50, "diverged": 0.0}
    row |= {"lqr_mean": -100.0, "controller": "learned"}
    assert verdict(row, {"mean": -100.0, "n": 50, "diverged": 0.0}) == expected


def outcome(start, lqr, learned, *, ends=(0.0, 0.0), accepted=False, moved=False, replaces=True):
    """Results with costs on the real plant at the start and after two generations."""

    def row(generation, controller, cost, ci):
        gain = {"mean": (ci[0] + ci[1]) / 2, "ci95": list(ci)}
        return {"plant": "real", "model": "real", "generation": generation, "controller": controller, "n": 30,
                "mean": -cost, "lqr_mean": -lqr if generation else -start, "diverged": 0.0,
                "paired_to_lqr": gain}  # fmt: skip

    redesigns = [None, {"accepted": accepted, "chosen": "redesign" if accepted else None}]
    entries = [
        {"generation": g + 1, "design": {"p": 2.0 if g == 0 or not moved else 3.0}, "redesign": redesigns[g],
         "online_updates": [{"accepted": False}], "account": f"generation {g + 1} did this and that",
         "delivery": {"replaces": replaces}}
        for g in range(2)
    ]  # fmt: skip
    rows = [row(0, "LQR", start, (0.0, 0.0)), row(0, "learned", start, (0.0, 0.0)), row(2, "LQR", lqr, (0.0, 0.0)),
            row(2, "learned", learned, ends)]  # fmt: skip
    space = {"names": ["p"], "units": ["-"], "lower": [1.0], "upper": [4.0]}
    return {"comparison": rows, "generations": entries, "start": {"p": 1.0}, "design_space": space, "quick": False}


@pytest.mark.parametrize(
    ("results", "sentence"),
    [
        (
            outcome(8384, 6425, 6425),
            "Real plant: cost −23 % (8384 → 6425), all of it from the design. The learned policy equals LQR. "
            "Generation 2 did this and that.",
        ),
        (
            outcome(100, 80, 72, ends=(7.9, 8.1), accepted=True),
            "Real plant: cost −28 % (100 → 72), −20 % from the design and −8 % from the policy. The learned policy "
            "costs 10 % less than LQR at the same design. Generation 2 changed the policy only.",
        ),
        (
            outcome(100, 100.1, 100, accepted=True, moved=True, ends=(-1, 1)),
            "Real plant: cost unchanged within 0.5 % (100 → 100). The learned policy and LQR cannot be told apart on "
            "these runs. Generation 2 moved the design to p = 3.",
        ),
        (
            outcome(0.0, 0.0, 0.004, ends=(-0.005, -0.003)),
            "Real plant: cost 0.004; LQR at the start design: 0. Generation 2 did this and that.",
        ),
        (
            outcome(100, 80, 80, accepted=True, replaces=False),
            "Real plant: cost −20 % (100 → 80), all of it from the design. The learned policy equals LQR. Generation 2 "
            "did this and that.",
        ),
    ],
)
def test_the_headline_says_what_came_out(results, sentence):
    assert headline(results) == sentence


@pytest.mark.parametrize(
    ("lqr", "learned", "origin"),
    [(90.0, 90.07, "all of it from the design"), (90.0, 90.6, "−10 % from the design and +0.6 % from the policy"),
     (99.93, 90.0, "all of it from the policy"), (99.4, 90.0, "−0.6 % from the design and −9.4 % from the policy")],
)  # fmt: skip
def test_a_fiftieth_of_a_change_goes_unmentioned(lqr, learned, origin):
    assert origin in headline(outcome(100.0, lqr, learned))


@pytest.mark.parametrize("status", ["worse", "not better"])
def test_the_headline_calls_no_generation_worse_that_was_not_shown_to_be(status):
    results = outcome(100, 42, 40, accepted=True, moved=True, ends=(1.9, 2.1))
    third = {**results["generations"][1], "generation": 3, "delivery": {"replaces": False, "status": status}}
    results["generations"].append(third)
    results["comparison"] += [row | {"generation": 3} for row in results["comparison"] if row["generation"] == 2]
    assert headline(results).endswith(
        f"Generation 2 moved the design to p = 3; generation 3 was rolled back: {status}."
    )


def test_the_headline_tells_a_redesign_from_the_policy():
    gains = {"design": 40.0, "policy": 0.3, "updates": 5.0, "redesign": 14.7, "total": 60.0}
    place = {"place": "real plant", "start": -100.0, "steps": 10}
    place |= {name: {"mean": gain, "ci95": [gain, gain]} for name, gain in gains.items()}
    results = outcome(100, 42, 40, accepted=True, moved=True, ends=(1.9, 2.1)) | {"gains": [place]}
    origin = "(100 → 40), −40 % from the design, −5 % from updates and −15 % from the redesign. The learned"
    assert origin in headline(results)


@pytest.mark.parametrize(
    ("cost", "said"),
    [(82.0, "The learned policy costs 2.5 % more than LQR here"),
     (80.1, "The learned policy costs as much as LQR within 0.5 % here"),
     (72.0, "The learned policy costs 10 % less than LQR here")],
)  # fmt: skip
def test_the_headline_claims_nothing_of_a_run_without_an_interval(cost, said):
    results = outcome(100, 80, cost)
    row = next(r for r in results["comparison"] if (r["generation"], r["controller"]) == (2, "learned"))
    row["paired_to_lqr"] = {"mean": 80.0 - cost, "ci95": [None, None]}
    assert f"{said}, without an interval (the run is too short, or drifts)" in headline(results)
    assert verdict(row, row) == "open"


def limit_row(controller, *, ends=(0.0, 0.0), depth=0.0, further=()):
    """A row on the real plant whose paired difference and depth outside X are given; LQR returns −100."""
    gain = {"mean": sum(ends) / 2, "ci95": list(ends)}
    return {"plant": "real", "model": "real", "generation": 1, "controller": controller, "n": 50, "diverged": 0.0,
            "mean": -100.0 + gain["mean"], "lqr_mean": -100.0, "paired_to_lqr": gain, "depth_peak": depth,
            "exceeded": "speed > 0.5" if depth else "", "further_outside_than": list(further)}  # fmt: skip


@pytest.mark.parametrize(
    ("ends", "further", "expected"),
    [((4.0, 6.0), ("LQR",), "better in return only"), ((4.0, 6.0), ("MPC",), "better in return only"),
     ((4.0, 6.0), ("PID",), "better"), ((-0.1, 0.1), ("MPC",), "equal"),
     ((-0.1, 0.1), ("LQR",), "equal in return only"),
     ((-6.0, -4.0), ("LQR", "MPC"), "worse"), ((-6.0, 4.0), ("LQR",), "open")],
)  # fmt: skip
def test_better_is_not_said_of_a_controller_that_is_better_by_leaving_X(ends, further, expected):
    assert verdict(limit_row("learned", ends=ends, depth=1.0, further=further), limit_row("LQR")) == expected


def test_worse_is_qualified_where_lqr_is_better_by_leaving_X():
    lqr = limit_row("LQR", depth=0.6, further=("learned", "MPC"))
    assert verdict(limit_row("learned", ends=(-6.0, -4.0)), lqr) == "worse in return only"
    assert verdict(limit_row("learned", ends=(4.0, 6.0)), lqr) == "better"


def test_the_note_below_the_table_says_who_leaves_X_how_far():
    learned = limit_row("learned", ends=(4.0, 6.0), depth=0.99, further=("LQR", "MPC"))
    rows = [limit_row("LQR"), limit_row("MPC", depth=0.04), learned]
    assert limit_notes(rows) == [
        "real plant, generation 1: learned is better than LQR in return only: it leaves X by 0.99 half-widths "
        "(speed > 0.5); LQR 0, MPC 0.040"
    ]
    assert limit_notes([limit_row("LQR"), limit_row("learned", ends=(4.0, 6.0))]) == []


def test_the_headline_says_that_X_was_left_for_it():
    results = outcome(100, 80, 72, ends=(7.9, 8.1), accepted=True)
    for row in results["comparison"]:
        further = ["LQR"] if row["controller"] == "learned" else []
        row |= {"depth_peak": 0.99 if further else 0.0, "exceeded": "v > 0.5" if further else ""}
        row["further_outside_than"] = further
    assert "costs 10 % less than LQR at the same design, but leaves X further (0.99 half-widths (v > 0.5); LQR 0)" in (
        headline(results)
    )


def limits(kept, fraction=0.1833):
    return {"kept": kept, "achieved": {"fraction": fraction, "depth": 0.836},
            "tolerance": {"fraction": 0.001, "depth": 0.002}}  # fmt: skip


def with_limits(first, second, **changes):
    results = outcome(100.0, 90.0, 88.0, ends=(1.5, 2.5), **changes)
    for generation, found in zip(results["generations"], (first, second)):
        generation["limits"] = found
    for row in results["comparison"]:
        row["exceeded"] = "tyre load [N] > 500" if row["controller"] == "learned" else ""
    return results


def test_the_headline_says_that_the_optimum_breaks_a_limit_that_all_controllers_break():
    said = "The co-design breaks the limits (18 % of the states outside X, 0.84 half-widths at the peak, the " \
           "tolerance is 0.1 % and 0.0020; on the real plant most tyre load [N] > 500)"  # fmt: skip
    assert said in headline(with_limits(limits(True), limits(False), accepted=True, moved=True))
    assert said in headline(with_limits(limits(False), limits(True), moved=False))  # its redesign was not taken


@pytest.mark.parametrize(
    "results",
    [
        with_limits(limits(False), limits(True), accepted=True, moved=True),
        with_limits(limits(True), limits(False)),  # not taken
        with_limits(limits(True), limits(False), accepted=True, replaces=False),  # rolled back
        with_limits(None, None, accepted=True),  # switched off
    ],
)
def test_the_headline_is_silent_on_limits_that_what_is_deployed_keeps(results):
    assert "limits" not in headline(results)


def metric(name, before, after, half):
    change = {"mean": after - before, "ci95": [after - before - half, after - before + half]}
    word = "open" if half > abs(after - before) else "worse" if after > before else "better"
    return {"name": name, "before": before, "after": after, "change": change, "word": word}


def with_places(results, *metrics):
    """Results with one other place, in which the learned policy is 6 % worse than LQR."""
    gain = {"mean": 20.0, "ci95": [19.0, 21.0]}
    none = {"mean": 0.0, "ci95": [0.0, 0.0]}
    place = {"start": -100.0, "design_cost": 0.0, "runs": 5, "steps": 10, "left_out": 0.0, "design": gain,
             "policy": none, "updates": none, "redesign": none, "total": gain}  # fmt: skip
    results["gains"] = [place | {"place": "drive", "metrics": metrics[:-1]},
                        place | {"place": "start", "metrics": metrics}]  # fmt: skip
    same = {"plant": "held out: start", "model": "start", "generation": 2, "n": 30, "diverged": 0.0, "lqr_mean": -50.0}
    results["held_out"] = [
        same | {"controller": "LQR", "mean": -50.0, "paired_to_lqr": {"mean": 0.0, "ci95": [0.0, 0.0]}},
        same | {"controller": "learned", "mean": -53.0, "paired_to_lqr": {"mean": -3.0, "ci95": [-3.1, -2.9]}},
    ]
    return results


def test_the_headline_names_every_number_that_got_worse_and_where():
    noise = metric("noise [dB]", 10.0, 12.0, 0.5)
    wear = metric("wear [mm]", 10.0, 12.0, 5.0)
    said = headline(with_places(outcome(100, 80, 80), noise, wear, metric("heat [K]", 4.0, 5.0, 0.1)))
    assert "Worse: noise +20 %, heat +25 % (start)." in said
    assert "wear" not in said


def test_the_headline_names_a_number_in_the_place_where_it_got_worst():
    results = with_places(outcome(100, 80, 80), metric("noise [dB]", 10.0, 11.0, 0.5), metric("heat [K]", 4, 4, 1))
    results["gains"][1] = results["gains"][1] | {"metrics": (metric("noise [dB]", 10.0, 15.0, 0.5),)}
    assert "Worse: noise +50 % (start)." in headline(results)


def test_the_headline_does_not_call_a_policy_equal_to_LQR_that_is_worse_somewhere():
    said = headline(with_places(outcome(100, 80, 80), metric("noise [dB]", 10.0, 9.0, 0.5)))
    assert "The learned policy equals LQR, but it is worse than LQR with start (+6 % cost)." in said
    assert "Worse" not in said


def test_headline_and_table_take_the_cost_from_the_same_runs():
    results = with_places(outcome(102, 80, 80), metric("noise [dB]", 10.0, 9.0, 0.5))
    assert headline(results).startswith("Real plant: cost −20 % (100 → 80), all of it from the design")


def test_the_headline_says_that_a_deployment_returned_less_than_predicted():
    results = outcome(100, 80, 80)
    first, second = (generation["delivery"] for generation in results["generations"])
    for one in (first, second):  # the second deployed nothing new
        one["predicted"] = {"mean": -45.0, "ci95": [-46.0, -44.0]}
        one["returns"] = {"mean": -63.0, "ci95": [-99.0, -48.0]}
    assert headline(results).count("less than predicted") == 1
    assert "The deployment of generation 1 returned 40 % less than predicted (−45.00 → −63.00;" in headline(results)
    first["returns"]["ci95"][1] = -45.5  # as predicted, so that the second is news
    assert "The deployment of generation 2 returned 40 % less than predicted" in headline(results)
    second["returns"]["ci95"][1] = -45.5
    assert "predicted" not in headline(results)


def test_a_plant_that_changed_is_said_first_and_asks_for_another_log():
    results = outcome(100, 80, 80)
    results["real_plant_changes"] = True
    results["generations"][-1]["drift"] = {"status": "drift", "advice": DriftStatus.DRIFT.advice}
    said = headline(results)
    assert "All of this is on the real plant as the last generation met it; generation 2 found that" in said
    assert next_steps(results) == ["The twin no longer describes the plant: log again, then redesign"]
    results["generations"][-1]["drift"] = {"status": "no drift", "advice": DriftStatus.NONE.advice}
    assert "found that the plant" not in headline(results)


@pytest.mark.parametrize(
    ("mean", "ends", "text"),
    [(-23.4, (-26.0, -23.1), "−23.4 % [−26, −23.1]"), (0.003, (-0.001, 0.006), "0 % [0, +0.01]"),
     (5.0, (5.0, 5.0), "+5 % [+5, +5]"), (-23.0, (-26.0, -20.0), "−23 % [−26, −20]")],
)  # fmt: skip
def test_an_interval_does_not_end_on_its_estimate_by_rounding(mean, ends, text):
    assert percent_interval(mean, ends, 100) == text


def test_advice_is_of_the_codesign_that_is_deployed_and_names_its_bounds():
    results = outcome(100, 80, 80)
    for generation, advice in zip(results["generations"], (CoDesignStatus.AT_BOUND.advice, "Raise it.")):
        generation |= {"codesign": {"advice": advice}, "active_bounds": {"p": "upper"}, "active_constraints": {}}
    assert next_steps(results) == [
        "Widen or relax p (upper bound), if the plant allows it: the return still rises across them"
    ]
    results["generations"][1]["redesign"] = {"accepted": True, "chosen": "redesign"}
    assert next_steps(results) == ["Raise it"]


def test_means_of_fewer_runs_share_no_column():
    lqr = limit_row("LQR") | {"metrics": {"noise": 1.0}}
    few = limit_row("MPC") | {"n": 2, "metrics": {"noise": 0.5}}
    table = metric_table([lqr, few])
    assert [(line["values"], line["star"]) for line in table["lines"]] == [([1.0], False), ([None], True)]
    place = {"place": "road", "steps": 10}
    rows = [row | {"model": "road"} for row in (lqr, few)]
    (_, shown) = held_out_rows({"gains": [place | {"place": "drive"}, place], "comparison": [], "held_out": rows}, 10)
    assert shown["cells"][1] == {"mean": "n/a *", "against": "0 %", "verdict": "equal"}


def test_a_difference_without_an_interval_keeps_its_per_cent():
    rows = [limit_row("LQR"), limit_row("PID") | {"paired_to_lqr": {"mean": -6.0, "ci95": [None, None]}}]
    rows = [row | {"model": "road"} for row in rows]
    places = [{"place": "drive", "steps": 10}, {"place": "road", "steps": 10}]
    shown = held_out_rows({"gains": places, "comparison": [], "held_out": rows}, 10)
    assert shown[1]["cells"][1]["against"] == "−6 %"
