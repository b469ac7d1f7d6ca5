"""Headline of a run's outcome."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccdtools.evidence.percent import number, share, signed_percent, with_minus
from ccdtools.plants.tolerances import SAME_DESIGN
from ccdtools.studies.names import FORMER
from ccdtools.studies.report.formatting import capitalised, design_text, limits_of
from ccdtools.studies.report.gains import gain_percent, held_out_phrase
from ccdtools.studies.report.summary import bare, deployed_codesign, drifts, of_word
from ccdtools.studies.report.verdicts import outside_text, percent_of_reference, reference_of, size_of, verdict
from ccdtools.studies.tolerances import EQUAL_PERCENT, NOT_WORSE_PERCENT, SMALL_PART

Results = Mapping[str, Any]
BESIDE_LQR = {  # by the verdict on the return
    "equal": "the learned policy equals LQR{within}",
    "better": "the learned policy costs {part} less than LQR at the same design",
    "worse": "the learned policy costs {part} more than LQR at the same design",
    "not worse": "the learned policy is not worse than LQR at the same design",
    "open": "the learned policy and LQR cannot be told apart on these runs",
}
BROUGHT_BY = {"design": "the design", "policy": "the policy", "updates": "updates", "redesign": "the redesign"}


def headline(results: Results) -> str:
    """Sentences on cost before and after, sources and generations."""
    last = len(results["generations"])
    idle = _no_further_gain(results)
    changes = [idle] if idle else _generations(results)
    cost = "; ".join(part for part in (_cost(results, last), held_out_phrase(results)) if part)
    sentences = [
        cost, _worn(results), _worse(results), _policy(results, last), _limits(results, last), _judged_by(results),
        "; ".join(changes), *_missed_predictions(results),
    ]  # fmt: skip
    text = " ".join(f"{capitalised(sentence)}." for sentence in sentences if sentence)
    return f"QUICK run, not a result. {text}" if results["quick"] else text


def _missed_predictions(results: Results) -> list[str]:
    """Deployments whose 95 % interval lies below the predicted one, once where nothing new is deployed."""
    said, missed = [], False
    for generation in results["generations"]:
        expected, found = (generation["delivery"].get(name, {}) for name in ("predicted", "returns"))
        ends = (expected.get("ci95", (None,))[0], found.get("ci95", (None,))[-1])
        before, missed = missed, None not in ends and ends[0] > ends[1] and bool(expected["mean"])
        if missed and not (before and generation["redesign"] and not generation["redesign"]["accepted"]):
            less = share((expected["mean"] - found["mean"]) / abs(expected["mean"]))
            returns = " → ".join(with_minus(number(one["mean"])) for one in (expected, found))
            said.append(f"the deployment of generation {generation['generation']} returned {less} less than predicted "
                        f"({returns}; 95 % intervals apart)")  # fmt: skip
    return said


def _worn(results: Results) -> str:
    """Phrase for a real plant that did not stay the same."""
    drifted = [f"generation {one['generation']} found that the plant had changed" for one in drifts(results)]
    met = "all of this is on the real plant as the last generation met it" if results.get("real_plant_changes") else ""
    return "; ".join(part for part in (met, *drifted) if part)


def _worse(results: Results) -> str:
    """Worse numbers other than the cost, with change and place."""
    first = results["gains"][0]["place"] if results.get("gains") else ""
    named = [
        f"{bare(name)} {one.text.split(' [')[0]}" + ("" if one.place == first else f" ({one.place})")
        for name, one in of_word(results, "worse").items()
    ]
    return f"worse: {', '.join(named)}" if named else ""


def _judged_by(results: Results) -> str:
    """Phrase for the measure judged by; empty for the mean."""
    measure = results.get("measure", "mean")
    if measure != "mean":
        return f"these are mean costs, the study is judged by the {measure}"
    optimised = results.get("optimised", "mean")
    if optimised == "mean":
        return ""
    return (
        f"these are mean costs, generation 1 was optimised for the {optimised}, and what followed is judged by the mean"
    )


def _no_further_gain(results: Results) -> str:
    """Sentence that later generations brought nothing; empty if one did."""
    later = results["generations"][1:]
    if not later or any(_brought(generation) for generation in later):
        return ""
    several = f"generations 2 to {len(later) + 1} brought nothing; " if len(later) > 1 else ""
    return several + str(later[-1]["account"]).split(": ")[0]


def _brought(generation: Mapping[str, Any]) -> bool:
    """Whether a later generation changed what is deployed."""
    delivery = generation["delivery"]
    if not delivery["replaces"]:
        return bool(delivery.get("carried"))  # the policy of the former generation before its updates is deployed again
    return generation["redesign"]["accepted"] or any(update["accepted"] for update in generation["online_updates"])


def _row(results: Results, generation: int, controller: str) -> dict[str, Any]:
    """Row of the comparison on the real plant, empty if there is none."""
    rows = (r for r in results["comparison"] if r["plant"] == "real" and r["generation"] == generation)
    return next((r for r in rows if r["controller"] == controller), {})


def _cost(results: Results, last: int) -> str:
    """Change of cost from LQR at the start design to the last policy."""
    before = _row(results, 0, "LQR")
    lqr = _row(results, last, "LQR")
    after = _row(results, last, "learned")
    place = next(iter(results.get("gains", ())), None)
    brought = {}
    if place is not None and gain_percent(place, "total") is not None:  # the runs of the table
        before = before | {"mean": place["start"]}
        after = after | {"mean": place["start"] + place["total"]["mean"]}
        brought = {source: place[source]["mean"] for source in BROUGHT_BY}
    lost = f", with {share(after['diverged'])} of its runs diverged" if after["diverged"] else ""
    if after["mean"] is None:
        return "real plant: every run of the learned policy diverges"
    if before["mean"] is None or before["mean"] == 0 or not (brought or lqr["mean"] is not None):
        return f"real plant: cost {_cost_text(after)}{lost}; LQR at the start design: {_cost_text(before)}"
    change = 100 * (before["mean"] - after["mean"]) / (size_of(before) or abs(before["mean"]))
    of = " of what control costs" if before.get("design_cost") else ""
    costs = f"({_cost_text(before)} → {_cost_text(after)}{lost})"
    if abs(change) < NOT_WORSE_PERCENT:
        return f"real plant: cost unchanged within {NOT_WORSE_PERCENT:g} %{of} {costs}"
    brought = brought or {"design": lqr["mean"] - before["mean"], "policy": after["mean"] - lqr["mean"]}
    return f"real plant: cost {signed_percent(change)}{of} {costs}, {_origin(brought, before)}"


def _origin(brought: Mapping[str, float], before: Mapping[str, Any]) -> str:
    """Phrase for what brought a change of the return."""
    whole = sum(brought.values())
    told = {source: gain for source, gain in brought.items() if abs(gain) > SMALL_PART * abs(whole)}
    if len(told) == 1:
        return f"all of it from {BROUGHT_BY[next(iter(told))]}"
    size = size_of(before) or abs(before["mean"])
    *parts, end = (f"{signed_percent(-100 * gain / size)} from {BROUGHT_BY[source]}" for source, gain in told.items())
    return f"{', '.join(parts)} and {end}"


def _policy(results: Results, last: int) -> str:
    rows = [row for row in results.get("held_out", ()) if row["generation"] == last]
    words: dict[str, list[str]] = {}
    for row in rows:
        reference = reference_of(rows, row)
        percent = percent_of_reference(row, reference)
        word = verdict(row, reference)
        if row["controller"] == "learned" and word in ("worse", "open"):
            cost = f" ({signed_percent(-percent[0])} cost)" if percent is not None else ""
            words.setdefault(word, []).append(row["model"] + cost)
    elsewhere = [f"worse than LQR with {', '.join(words['worse'])}"] if "worse" in words else []
    elsewhere += [f"not told apart from LQR with {', '.join(words['open'])}"] if "open" in words else []
    there = ", ".join(part for part in (_where_deployed(results, last), _best_other(results, last)) if part)
    return ", but ".join(part for part in (there, f"it is {' and '.join(elsewhere)}" if elsewhere else "") if part)


def _where_deployed(results: Results, last: int) -> str:
    row = _row(results, last, "learned")
    reference = _row(results, last, "LQR")
    percent = percent_of_reference(row, reference)
    word = verdict(row, reference)
    only = word.endswith(" in return only")
    if percent is None and word == "open":
        return _without_interval(row)
    sentence = _return_beside_lqr(word.removesuffix(" in return only"), percent)
    if not (only and sentence):
        return sentence
    left = limits_of(results)
    if word.startswith("worse"):
        return f"{sentence}, which leaves {left} further ({outside_text(reference, results['comparison'])})"
    return f"{sentence}, but leaves {left} further ({outside_text(row, results['comparison'])})"


def _best_other(results: Results, last: int) -> str:
    """Phrase for the best baseline if it costs less than LQR; else empty."""
    lqr = _row(results, last, "LQR")
    rows = [row for row in results["comparison"] if (row["plant"], row["generation"]) == ("real", last)]
    others = [row for row in rows if not (row["controller"].startswith("learned") or row.get("remark"))]
    best = max(others, key=_gain)  # LQR at worst
    if _gain(best) < NOT_WORSE_PERCENT or verdict(best, lqr).startswith("worse"):
        return ""
    unsure = "" if percent_of_reference(best, lqr) else " (without an interval)"
    return f"the best other law ({best['controller']}) {signed_percent(_gain(best)).removeprefix('+')} less{unsure}"


def _gain(row: Mapping[str, Any]) -> float:
    """Mean gain over LQR in per cent of LQR's cost; 0 where there is none."""
    mean, size = row["paired_to_lqr"]["mean"], size_of(row, "lqr_mean")
    return float(100 * mean / size) if mean is not None and size else 0.0


def _limits(results: Results, last: int) -> str:
    """Sentence that the deployed co-design violates its limits."""
    generation = deployed_codesign(results)
    found = None if generation is None else generation.get("limits")
    if found is None or found["kept"]:
        return ""
    achieved, most = ((of["fraction"], of["depth"]) for of in (found["achieved"], found["tolerance"]))
    outside = f"{share(achieved[0])} of the states outside {limits_of(results)}"
    left = f"{outside}, {number(achieved[1], 2)} half-widths at the peak"
    asked = f"the tolerance is {share(most[0])} and {number(most[1], 2)}"
    exceeded = _row(results, last, "learned")["exceeded"]
    which = f"; on the real plant most {exceeded}" if exceeded else ""
    return f"the co-design breaks the limits ({left}, {asked}{which})"


def _without_interval(row: Mapping[str, Any]) -> str:
    percent = -100 * row["paired_to_lqr"]["mean"] / (size_of(row, "lqr_mean") or abs(row["lqr_mean"]))
    if abs(percent) < NOT_WORSE_PERCENT:
        costs = f"as much as LQR within {NOT_WORSE_PERCENT:g} %"
    else:
        costs = f"{signed_percent(abs(percent)).removeprefix('+')} {'more' if percent > 0 else 'less'} than LQR"
    return f"the learned policy costs {costs} here, without an interval (the run is too short, or drifts)"


def _return_beside_lqr(word: str, percent: tuple[float, float, float] | None) -> str:
    if percent is None:
        return "the learned policy equals LQR" if word == "equal" else ""
    exact = max(abs(percent[1]), abs(percent[2])) <= EQUAL_PERCENT
    within = "" if exact else f" within {NOT_WORSE_PERCENT:g} %"
    return BESIDE_LQR[word].format(within=within, part=signed_percent(abs(percent[0])).removeprefix("+"))


def _generations(results: Results) -> list[str]:
    """Sentences on generations that changed less than the design."""
    space = results["design_space"]
    width = [high - low or 1.0 for low, high in zip(space["lower"], space["upper"])]  # 1 where it is fixed
    before = results["start"]
    phrases = []
    for generation in results["generations"]:
        now = generation["design"]
        away = max(abs(now[name] - before[name]) / w for name, w in zip(space["names"], width))
        phrases.append(_phrase(results, generation, moved=away > SAME_DESIGN))
        before = now
    return [phrase for phrase in phrases if phrase]


def _phrase(results: Results, generation: Mapping[str, Any], *, moved: bool) -> str:
    """Phrase for what one generation changed; empty for an expected first."""
    name = f"generation {generation['generation']}"
    redesign = generation["redesign"]
    updated = any(update["accepted"] for update in generation["online_updates"])
    if redesign is None:
        return "" if moved else f"{name} left the design where it was"
    delivery = generation["delivery"]
    if not delivery["replaces"]:
        if delivery.get("carried"):
            updates = f"the updates of generation {delivery['former']}"
            return f"{name} rolled {updates} back after a whole deployment: {delivery['status']}"
        return f"{name} was rolled back: {delivery['status']}"
    if redesign["accepted"] and redesign["chosen"].startswith(FORMER):
        return f"{name} returned to {redesign['chosen'].removeprefix(FORMER)}"
    if moved:
        return f"{name} moved the design to {design_text(results, generation['design'])}"
    return f"{name} changed the policy only" if redesign["accepted"] or updated else f"{name} changed nothing"


def _cost_text(row: Mapping[str, Any]) -> str:
    """Cost of a row as text: minus its mean return."""
    return "all runs diverged" if row["mean"] is None else f"{0.0 - row['mean']:.4g}"
