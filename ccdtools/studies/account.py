"""Sentence on each generation: change, prediction, measurement and source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.evidence.percent import in_measure, percent_interval, share, with_minus
from ccdtools.evidence.verdict import Status
from ccdtools.studies.report.formatting import FORMER, number
from ccdtools.studies.service import Agreement

Values = Mapping[str, Any]


def account(generation: int, deployed: Values, redesign: Values | None, place: str) -> str:
    """Sentence on a generation, without a full stop.

    Parameters
    ----------
    generation : int
    deployed : mapping
        Of its deployment: ``deployed_return``, ``delivery``, ``updates``.
    redesign : mapping or None
        Of its co-design; None for the first one.
    place : str
        The deployed design with its units.
    """
    name = f"generation {generation}"
    delivery = deployed["delivery"]
    updates = deployed["updates"]
    accepted = sum(update["accepted"] for update in updates)
    if redesign is None:
        expected, found = (with_minus(number(delivery[which]["mean"])) for which in ("predicted", "returns"))
        missed = ", less than predicted" if Agreement(delivery["agreement"]) is Agreement.LESS else ""
        returns = f"predicted a deployed return of {expected}, measured {found}{missed}"
        return "; ".join([f"{name} designed {place} on the nominal model", returns,
                          _updates(accepted, updates, "the policy is as designed")])  # fmt: skip
    if redesign["accepted"]:
        return "; ".join([*_redesigned(name, redesign, delivery, place), *_less_than_predicted(delivery),
                          _updates(accepted, updates, "none of it is due to updates")])  # fmt: skip
    changed = "changed nothing" if not accepted else "changed the policy only, by updates while deployed"
    if not delivery["replaces"]:
        changed = f"was {_verdict(delivery)}{_rolled_back(delivery, accepted)}"
    measured = [f"measured {_change(delivery)}"] if accepted and delivery["replaces"] else []
    kept = _updates(accepted, updates, _kept(delivery, accepted))
    return "; ".join([f"{name} {changed}: {refusal(redesign)}", *measured, *_less_than_predicted(delivery), kept])


def _verdict(delivery: Values) -> str:
    """Reason why what was deployed does not stay."""
    if delivery["status"] == Status.LIMITS.value:
        return f"{delivery['status']} ({delivery['breach']})"
    if delivery["status"] == Status.MORE_LOST.value:
        return f"rolled back, {delivery['status']}: {delivery['reason']}"
    return f"{delivery['status']} than generation {delivery['former']} ({_change(delivery)})"


def _rolled_back(delivery: Values, accepted: int) -> str:
    """Clause on the updates that were rolled back."""
    if delivery.get("carried"):
        return f", so that the updates of generation {delivery['former']}, measured by a whole deployment, were " \
               "rolled back"  # fmt: skip
    return " and its updates were rolled back" if accepted else ", though nothing had changed"


def refusal(redesign: Values) -> str:
    """Reason why no redesign was deployed."""
    decision = redesign["decisions"]["redesign"]
    best = "the best redesign found" if decision["moved"] else "the best policy found"
    return f"{best} was predicted {decision['predicted']} and refused, {decision['reason']}"


def region_line(region: Values) -> str:
    """Sentence on how far a redesign may go, and why."""
    if region["radius"] is None:
        return f"redesign over the whole box: {region['text']}"
    return f"redesign limited to ±{share(region['radius'])} of the box around what is deployed: {region['text']}"


def _redesigned(name: str, redesign: Values, delivery: Values, place: str) -> list[str]:
    """Clauses on what a redesign changed, predicted and measured."""
    decision = redesign["decisions"][redesign["chosen"]]
    what = f"moved the design to {place}" if decision["moved"] else "changed the policy at the same design"
    if redesign["chosen"].startswith(FORMER):
        what = f"returned to {redesign['chosen'].removeprefix(FORMER)}, {place}"
    elif redesign["region"]["edges"] and decision["moved"]:
        what = f"{what}, at the edge of the trust region ({', '.join(redesign['region']['edges'])})"
    measured = f"measured {_change(delivery)} against generation {delivery['former']}"
    said = [f"{name} {what}, predicted {decision['predicted']} and {measured}"]
    if not delivery["replaces"]:
        why = delivery["status"] + (f" ({delivery['breach']})" if delivery["breach"] else "")
        said.append(f"{why}, so design and policy of generation {delivery['former']} stay deployed")
    return said


def _less_than_predicted(delivery: Values) -> list[str]:
    """Clause that less was measured than predicted; empty otherwise."""
    if Agreement(delivery["agreement"]) is not Agreement.LESS:
        return []
    return [f"{delivery['agreement']}, a deployed return of {with_minus(number(delivery['predicted']['mean']))}"]


def _change(delivery: Values) -> str:
    """Measured change in per cent of the deployed return."""
    change = delivery["change"]
    return percent_interval(change["mean"], change["ci95"], delivery["size"]) + in_measure(delivery["measure"])


def _kept(delivery: Values, accepted: int) -> str:
    """Clause on what became of the deployed policy."""
    before = delivery["former"]
    if accepted and delivery["replaces"]:
        return f"design of generation {before}, policy updated"
    if delivery.get("carried") and not delivery["replaces"]:
        return f"the deployed policy is that of generation {before} before its updates"
    return f"the deployed policy is that of generation {before}, unchanged"


def _updates(accepted: int, updates: Sequence[Any], consequence: str) -> str:
    """Clause on the number of accepted updates."""
    if not updates:
        return f"no update was tried; {consequence}"
    said = f"{accepted} of {len(updates)} updates accepted"
    return said if accepted else f"{said}, {consequence}"
