"""What happened in a campaign and what went wrong, from its journal, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

from namod_ctl.app.report.document import Block, Chapter, Table, Text
from namod_ctl.app.report.parts import when_text
from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import m_to_mm
from namod_ctl.cycle.machine import STATES
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import TRANSITION, Event, JournaledOrder

_KINDS = {
    "check": "found when everything was checked",
    "finding": "found from what was recorded",
    "refused": "left as it was",
    "instructions": "sheets were written",
    "done": "marked as done",
    "control": "a request could not be understood",
    "undone_in": "a correction was taken back",
    "psf_check": "looked through the PSF camera",
}
_TROUBLE_KINDS = frozenset({"check", "finding", "refused", "control", "undone_in"})
_TROUBLE_TRIGGERS = frozenset({"poor_data", "undo", "hold", "fail", "changed", "release"})
_OUTCOMES = {
    MoveOutcome.REFUSED: "refused before it moved",
    MoveOutcome.STOPPED: "stopped on its way",
    MoveOutcome.OFF_TARGET: "stands elsewhere",
    MoveOutcome.FAULT: "the drive reports a fault",
    MoveOutcome.LOST: "the drive does not answer: nobody knows where the leg is",
    MoveOutcome.UNKNOWN: "ordered, and never read back",
}


def journal_chapter(events: Sequence[Event]) -> Chapter:
    """Everything that happened, in its order."""
    rows = journal_rows(events)
    if not rows:
        return Chapter("What happened", (Text("Nothing yet."),))
    return Chapter("What happened", (Table(("when", "what", "why"), rows, frozenset({1, 2})),))


def journal_rows(events: Sequence[Event]) -> tuple[tuple[str, str, str], ...]:
    """When, what and why, event by event; what was left alone for the same reason in one row."""
    return tuple((when_text(event.time_utc), *_words(event)) for event in _grouped(events))


def fault_chapter(store: CampaignStore) -> Chapter:
    """What went wrong, and what was done about it."""
    troubles = [
        event
        for event in store.events()
        if event.kind in _TROUBLE_KINDS or (event.kind == TRANSITION and event.data.get("trigger") in _TROUBLE_TRIGGERS)
    ]
    blocks: list[Block] = []
    if troubles:
        blocks.append(Table(("when", "what", "why"), journal_rows(troubles), frozenset({1, 2})))
    legs = [
        order for order in store.orders() if order.result is None or order.result.outcome is not MoveOutcome.ARRIVED
    ]
    if legs:
        blocks.append(Text(f"{len(legs)} orders did not bring their leg to its target:"))
        blocks.append(
            Table(("cycle", "leg", "target mm", "what came of it"), tuple(map(_leg_row, legs)), frozenset({1, 3}))
        )
    return Chapter(
        "Faults and what was done", tuple(blocks) or (Text("None: nothing was refused, and no leg failed."),)
    )


def outcome_text(order: JournaledOrder) -> str:
    """What came of an order that did not arrive."""
    if order.result is None:
        return _OUTCOMES[MoveOutcome.UNKNOWN]
    words = _OUTCOMES.get(order.result.outcome, order.result.outcome.value)
    return f"{words}: {order.result.detail}" if order.result.detail else words


def _leg_row(order: JournaledOrder) -> tuple[str, str, str, str]:
    leg = order.order.leg
    target_mm = m_to_mm(order.order.target_m)
    return str(order.cycle), f"facet {leg.facet_id} leg {leg.index + 1}", f"{target_mm:+.3f}", outcome_text(order)


def _words(event: Event) -> tuple[str, str]:
    if event.kind != TRANSITION:
        return _KINDS.get(event.kind, event.kind.replace("_", " ")), event.text
    state = str(event.data.get("to"))
    meaning = STATES.get(state, "")
    return f"{state.replace('_', ' ')}: {meaning}" if meaning else state, str(event.data.get("reason", event.text))


def _grouped(events: Sequence[Event]) -> list[Event]:
    """Facets that were left alone one after the other for one reason, as one event."""
    grouped: list[Event] = []
    facets: list[str] = []
    for event in events:
        last = grouped[-1] if grouped else None
        why = event.data.get("why")
        if event.kind == "refused" and last is not None and last.kind == "refused" and last.data.get("why") == why:
            facets.append(str(event.data.get("facet_id")))
            text = f"facets {', '.join(facets)}: {why}"
            grouped[-1] = Event(last.id, last.time_utc, last.kind, text, last.data)
            continue
        facets = [str(event.data.get("facet_id"))]
        grouped.append(event)
    return grouped
