"""Sentence on each generation: change, prediction, measurement and source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ccdtools.evidence.percent import number, share, with_minus
from ccdtools.evidence.verdict import Status, Verdict
from ccdtools.studies.names import FORMER
from ccdtools.studies.service import UPDATED_SINCE, Agreement, Delivery

if TYPE_CHECKING:
    from ccdtools.studies.redesign import Redesign
    from ccdtools.twin.online import OnlineUpdate


def account(
    generation: int, delivery: Delivery, updates: Sequence[OnlineUpdate], redesign: Redesign | None, place: str
) -> str:
    """Sentence on a generation, without a full stop.

    Parameters
    ----------
    generation : int
    delivery, updates
        Of its deployment.
    redesign : Redesign or None
        Of its co-design; None for the first one.
    place : str
        The deployed design with its units.
    """
    name = f"generation {generation}"
    accepted = sum(update.accepted for update in updates)
    less = delivery.agreement is Agreement.LESS
    expected = f"a deployed return of {with_minus(number(delivery.predicted.mean))}"
    if redesign is None:
        missed = f", {delivery.agreement.value}" if less else ""
        returns = f"predicted {expected}, measured {with_minus(number(delivery.returns.mean))}{missed}"
        clauses = [f"{name} designed {place} on the nominal model", returns]
        consequence = "the policy is as designed"
    elif redesign.accepted:
        clauses = [f"{name} {redesign.text} and {_measured(delivery, ' with its updates' if accepted else '')}"]
        if not delivery.replaces:
            stay = f"design and policy of generation {delivery.former} stay deployed"
            clauses.append(f"{_fell_short(delivery)}, so {stay}")
        consequence = "none of it is due to updates"
    else:
        clauses = [f"{name} {_without_redesign(delivery, accepted)}: {redesign.text}"]
        clauses += [_measured(delivery)] * (accepted > 0 and delivery.replaces)
        consequence = _kept(delivery, accepted)
    if redesign is not None and less:
        clauses.append(f"{delivery.agreement.value}, {expected}")
    tried = f"{accepted} of {len(updates)} updates accepted"
    last = f"{tried}, {consequence}" if updates else f"no update was tried; {consequence}"
    return "; ".join([*clauses, tried if accepted else last])


def proposed(name: str, verdict: Verdict, place: str, edges: Mapping[str, str], *, moved: bool) -> str:
    """Clause on what a proposal that is deployed changes and predicts."""
    what = f"moved the design to {place}" if moved else "changed the policy at the same design"
    if name.startswith(FORMER):
        what = f"returned to {name.removeprefix(FORMER)}, {place}"
    elif edges and moved:
        what = f"{what}, at the edge of the trust region ({', '.join(edges)})"
    return f"{what}, predicted {verdict.percent}"


def refused(verdict: Verdict, *, moved: bool) -> str:
    """Reason why no redesign was deployed."""
    best = "the best redesign found" if moved else "the best policy found"
    return f"{best} was predicted {verdict.percent} and refused, {verdict}"


def region_line(region: Mapping[str, Any]) -> str:
    """Sentence on how far a redesign may go, and why."""
    if region["radius"] is None:
        return f"redesign over the whole box: {region['text']}"
    return f"redesign limited to ±{share(region['radius'])} of the box around what is deployed: {region['text']}"


def _measured(delivery: Delivery, what: str = "") -> str:
    """Clause on a deployment beside the one before."""
    if delivery.verdict.status is Status.NOT_COMPARED:
        return f"not compared with generation {delivery.former}, {delivery.verdict.reason}"
    return f"measured{what} {delivery.verdict.percent} against generation {delivery.former}"


def _fell_short(delivery: Delivery) -> str:
    """Clause on why a deployment is rolled back; with its numbers where these are of a part of it."""
    verdict = delivery.verdict
    if delivery.breach:
        return f"{verdict.status.value} ({delivery.breach})"
    return str(verdict) if UPDATED_SINCE in verdict.reason else verdict.status.value


def _without_redesign(delivery: Delivery, accepted: int) -> str:
    if delivery.replaces:
        return "changed the policy only, by updates while deployed" if accepted else "changed nothing"
    rolled_back = " and its updates were rolled back" if accepted else ", though nothing had changed"
    if delivery.carried:
        rolled_back = (
            f", so that the updates of generation {delivery.former}, measured by a whole deployment, were rolled back"
        )
    status = delivery.verdict.status
    worse = f"{status.value} than generation {delivery.former} ({delivery.verdict.percent})"
    why = {Status.LIMITS: f"{status.value} ({delivery.breach})", Status.MORE_LOST: f"rolled back, {delivery.verdict}"}
    return f"was {why.get(status, worse)}{rolled_back}"


def _kept(delivery: Delivery, accepted: int) -> str:
    """Clause on what became of the deployed policy."""
    if accepted and delivery.replaces:
        return f"design of generation {delivery.former}, policy updated"
    as_it_was = " before its updates" if delivery.carried and not delivery.replaces else ", unchanged"
    return f"the deployed policy is that of generation {delivery.former}{as_it_was}"
