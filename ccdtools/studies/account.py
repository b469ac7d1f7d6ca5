"""One sentence a generation: what changed, what was promised, what was delivered, and what did it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ccdtools.studies.report.formatting import FORMER, in_measure, number, percent_interval, share, with_minus
from ccdtools.studies.service import JudgeStatus, ServiceStatus

Values = Mapping[str, Any]


def account(generation: int, deployed: Values, redesign: Values | None, place: str) -> str:
    """The sentence of a generation, without a full stop.

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
    accepted = sum(update["accepted"] for update in deployed["updates"])
    if redesign is None:
        return "; ".join([f"{name} designed {place} on the nominal model", _returns(delivery, deployed),
                          *(["the judge, here the nominal model, was wrong"] if _fell_short(delivery) else []),
                          _updates(accepted, deployed["updates"], "the policy is as designed")])  # fmt: skip
    if redesign["accepted"]:
        parts = [_redesigned(name, redesign, delivery, place), *_verdict(delivery)]
        return "; ".join([*parts, _updates(accepted, deployed["updates"], "all of it is the redesign's")])
    replaces = delivery["replaces"]
    kept = _kept(delivery, accepted)
    changed = "changed nothing" if not accepted else "changed the policy only, by updates while deployed"
    if not replaces:
        changed = f"{_fell_back(delivery)}{_taken_back(delivery, accepted)}"
    updates = _updates(accepted, deployed["updates"], kept)
    delivered = [f"delivered {_change(delivery)}"] if accepted and replaces else []
    return "; ".join([f"{name} {changed}: {refusal(redesign)}", *delivered, *_judged(delivery), updates])


def _fell_back(delivery: Values) -> str:
    """How a deployment that was no redesign fell short of the one before it."""
    if delivery["status"] == ServiceStatus.LIMITS.value:
        return f"was {delivery['status']} ({delivery['breach']})"
    if delivery["status"] == ServiceStatus.DIVERGED.value:
        return f"lost more runs than generation {delivery['former']} ({_change(delivery)})"
    return f"was {delivery['status']} than generation {delivery['former']} ({_change(delivery)})"


def _taken_back(delivery: Values, accepted: int) -> str:
    """What was taken back: updates of this deployment, or those of the former one, judged again by a whole one."""
    former = f"the updates accepted in generation {delivery['former']}"
    if delivery.get("carried"):
        also = " and its own" if accepted else ""
        return f", so that {former}{also}, judged again by a whole deployment, were taken back"
    return " and its updates were taken back" if accepted else ", though nothing had changed"


def refusal(redesign: Values) -> str:
    """Why no redesign was taken."""
    decision = redesign["decisions"]["redesign"]
    best = "the best redesign found" if decision["moved"] else "the best policy found"
    return f"{best} promised {decision['promise']}, {decision['reason']}"


def region_line(region: Values) -> str:
    """How far a redesign may go, and why."""
    if region["radius"] is None:
        return f"redesign over the whole box: {region['text']}"
    return f"redesign limited to ±{share(region['radius'])} of the box around what is in service: {region['text']}"


def _redesigned(name: str, redesign: Values, delivery: Values, place: str) -> str:
    """What a redesign changed and promised, and what it delivered."""
    decision = redesign["decisions"][redesign["chosen"]]
    what = f"moved the design to {place}" if decision["moved"] else "changed the policy at the same design"
    if redesign["chosen"].startswith(FORMER):
        what = f"returned to {redesign['chosen'].removeprefix(FORMER)}, {place}"
    elif redesign["region"]["edges"] and decision["moved"]:
        what = f"{what}, at the edge of the trust region ({', '.join(redesign['region']['edges'])})"
    gain = decision["gain"]
    promise = _percent(gain, delivery["size"], decision)
    delivered = f"delivered {_change(delivery)} against generation {delivery['former']}"
    return f"{name} {what}, promised {promise} and {delivered}"


def _verdict(delivery: Values) -> list[str]:
    """Whether a redesign stays in service, if it does not, and whether the judge was wrong."""
    status = ServiceStatus(delivery["status"])
    former = f"design and policy of generation {delivery['former']} stay in service"
    why = status.value if status is not ServiceStatus.LIMITS else f"{status.value} ({delivery['breach']})"
    return ([] if status.replaces else [f"{why}, so {former}"]) + _judged(delivery)


def _judged(delivery: Values) -> list[str]:
    """That the judge was wrong, where it was, with both returns."""
    if not _fell_short(delivery):
        return []
    promised = with_minus(number(delivery["promised"]["mean"]))
    return [f"the judge was wrong: it promised a deployed return of {promised}"]


def _fell_short(delivery: Values) -> bool:
    """Whether a deployment delivered less than was promised, beyond both intervals."""
    return JudgeStatus(delivery["judge"]) is JudgeStatus.LESS


def _returns(delivery: Values, deployed: Values) -> str:
    """Promised and deployed return of the first generation."""
    promised, delivered = (with_minus(number(s["mean"])) for s in (delivery["promised"], deployed["deployed_return"]))
    return f"promised a deployed return of {promised} and delivered {delivered}"


def _change(delivery: Values) -> str:
    """The change that a deployment delivered, in per cent of what was in service."""
    return _percent(delivery["change"], delivery["size"], delivery)


def _percent(change: Values, size: float | None, judged: Values) -> str:
    """A change in per cent of a return, in what of the returns was judged."""
    return percent_interval(change["mean"], change["ci95"], size) + in_measure(judged.get("measure", "mean"))


def _kept(delivery: Values, accepted: int) -> str:
    """What became of the policy in service."""
    before = delivery["former"]
    if accepted and delivery["replaces"]:
        return f"design of generation {before}, policy updated"
    if delivery.get("carried") and not delivery["replaces"]:
        return f"the policy in service is that of generation {before} before its updates"
    return f"the policy in service is that of generation {before}, unchanged"


def _updates(accepted: int, updates: Sequence[Any], consequence: str) -> str:
    """How many updates were accepted; the consequence where none was."""
    if not updates:
        return f"no update was tried; {consequence}"
    said = f"{accepted} of {len(updates)} updates accepted"
    return said if accepted else f"{said}, {consequence}"
