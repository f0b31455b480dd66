"""What the page shows of a campaign: where it stands, what may be asked of it, its cycles, legs and journal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any
from zlib import crc32

from namod_ctl.app.alignment_files import alignment_from_json
from namod_ctl.app.commands.status import describe
from namod_ctl.app.dashboard.numbers import short
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOutcome, MoveResult
from namod_ctl.core.units import k_to_celsius, m_to_mm, rad2_to_arcmin2
from namod_ctl.cycle.control import RequestKind
from namod_ctl.cycle.machine import FINAL, STATES
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import TRANSITION, Cycle, Event, JournaledOrder
from namod_ctl.store.live_legs import SeenLeg

N_EVENTS = 40

_ASKED_IN = {
    "recording": (RequestKind.PAUSE,),
    "paused": (RequestKind.RESUME,),
    "awaiting_approval": (RequestKind.APPROVE, RequestKind.REFUSE),
    "awaiting_operator": (RequestKind.DONE, RequestKind.NOT_DONE),
}
"""What makes sense in which state; to stop always does while somebody is at work. `release` is not for a page: who
releases has looked at the telescope."""


def commands_in(state: str, *, is_running: bool) -> list[str]:
    """What can be asked of the campaign at this moment."""
    if not is_running or state in FINAL:
        return []
    return [RequestKind.STOP.value, *(kind.value for kind in _ASKED_IN.get(state, ()))]


def what_next(state: str, n_to_turn: int, *, is_running: bool) -> str:
    """What somebody who looks at the page does next, or waits for."""
    if state == "held":
        return "somebody looks at the telescope, then says 'namod-ctl release' in a terminal"
    if state in FINAL:
        return "nothing: it has ended"
    if not is_running:
        return "nobody is at work on it: 'namod-ctl align --resume' in a terminal goes on"
    return {
        "awaiting_approval": "look at the prediction, then approve or refuse it: here, or in a terminal",
        "awaiting_operator": f"bolts of {n_to_turn} {'facet is' if n_to_turn == 1 else 'facets are'} turned; mark each "
        "facet that is done on the work sheet",
        "paused": "resume it when the recording shall go on",
    }.get(state, "it goes on by itself")


def standing(store: CampaignStore, pid: int | None) -> dict[str, Any]:
    """Where the campaign stands, and what happens next."""
    said = describe(store, pid)
    transition = store.last_transition()
    turns = store.turns()
    return {
        "kind": "campaign",
        "state": said["state"],
        "meaning": said["state_meaning"],
        "reason": said["reason"],
        "since_utc": said["since_utc"],
        "is_running": said["is_running"],
        "next": what_next(said["state"], len(said["turns_to_do"]), is_running=said["is_running"]),
        "step": transition.id if transition else 0,
        "commands": commands_in(said["state"], is_running=said["is_running"]),
        "refused": [{"id": int(facet_id), "why": why} for facet_id, why in said["refused_facets"].items()],
        "turns_of": turns[0].cycle if turns else None,
        "turns": [{"id": turn.facet_id, "is_done": turn.is_done} for turn in turns],
    }


def sheets(store: CampaignStore, cycles: list[Cycle]) -> list[dict[str, int]]:
    """Cycles that have a work sheet for the bolts, and the fingerprint of what it is made from."""
    return [
        {"key": cycle.number, "fingerprint": crc32(cycle.alignment_json.encode())}
        for cycle in cycles
        if cycle.alignment_json is not None and store.turns(cycle.number)
    ]


def cycle_table(cycles: list[Cycle]) -> list[dict[str, Any]]:
    """One entry per cycle; areas in square minutes of arc."""
    from_areas = {
        "now": "a_sigma_now_rad2",
        "uncertainty": "a_sigma_uncertainty_rad2",
        "predicted": "a_sigma_predicted_rad2",
        "limit": "a_sigma_limit_rad2",
    }
    return [
        {"cycle": cycle.number, "n_records": cycle.n_records, "decision": cycle.decision}
        | {name: short(rad2_to_arcmin2(getattr(cycle, attribute))) for name, attribute in from_areas.items()}
        for cycle in cycles
    ]


def alignments_of(cycles: list[Cycle], known: dict[int, tuple[int, Alignment]]) -> dict[int, Alignment]:
    """Alignments of the cycles that have one, by number; `known` remembers them by the hash of their text."""
    for cycle in cycles:
        if cycle.alignment_json is None:
            known.pop(cycle.number, None)
            continue
        fingerprint = hash(cycle.alignment_json)
        if cycle.number not in known or known[cycle.number][0] != fingerprint:
            alignment = alignment_from_json(cycle.alignment_json, f"cycle {cycle.number}")
            known[cycle.number] = (fingerprint, alignment)
    return {number: alignment for number, (_, alignment) in sorted(known.items())}


def actuators(store: CampaignStore) -> dict[str, Any]:
    """Every leg that was ever ordered to move or whose drive was read: its last order, and what its drive said last."""
    last = {journaled.order.leg: journaled for journaled in store.orders()}
    seen = store.seen_legs()
    latest = max((journaled.cycle for journaled in last.values()), default=None)
    legs = [_leg(leg, last.get(leg), seen.get(leg)) for leg in sorted({*last, *seen})]
    counts = Counter(leg["outcome"] for leg in legs if leg["outcome"])
    return {"cycle": latest, "counts": dict(counts), "drives": dict(_drive_counts(seen)), "legs": legs}


def _leg(leg: Leg, journaled: JournaledOrder | None, seen: SeenLeg | None) -> dict[str, Any]:
    result = None if journaled is None else journaled.result
    outcome = "" if journaled is None else (MoveOutcome.UNKNOWN if result is None else result.outcome).value
    position_m = math.nan if result is None else result.readback_m
    if seen is not None and seen.state is not None:
        position_m = seen.state.position_m
    return {
        "facet": leg.facet_id,
        "leg": leg.index + 1,
        "target_mm": None if journaled is None else short(m_to_mm(journaled.order.target_m)),
        "position_mm": short(m_to_mm(position_m)),
        "outcome": outcome,
        "detail": "ordered, not read back yet" if journaled is not None and result is None else _detail(result),
        "drive": "" if seen is None else _drive_in_words(seen),
        "is_bad": outcome not in ("", MoveOutcome.ARRIVED.value) or (seen is not None and _is_unwell(seen)),
    }


def _detail(result: MoveResult | None) -> str:
    return "" if result is None else result.detail


def _is_unwell(seen: SeenLeg) -> bool:
    return seen.state is None or bool(seen.state.faults) or not seen.state.is_homed


def _drive_in_words(seen: SeenLeg) -> str:
    state = seen.state
    if state is None:
        return f"no word from its drive: {seen.silence}"
    words = ["moves" if state.is_moving else "stands still", *state.faults]
    if not state.is_homed:
        words.append("not homed")
    if state.temperature_k is not None:
        words.append(f"{k_to_celsius(state.temperature_k):.0f} °C")
    return ", ".join(words)


def _drive_counts(seen: Mapping[Leg, SeenLeg]) -> Counter[str]:
    """Drives by what matters most of each, as a person would count them."""
    counts: Counter[str] = Counter()
    for each in seen.values():
        if each.state is None:
            counts["silent"] += 1
        elif each.state.faults:
            counts["with a fault"] += 1
        elif not each.state.is_homed:
            counts["not homed"] += 1
        else:
            counts["moving" if each.state.is_moving else "well and still"] += 1
    return counts


def journal(events: list[Event]) -> list[dict[str, Any]]:
    """The last events in plain words, the newest first."""
    return [
        {"id": event.id, "time_utc": event.time_utc, "kind": event.kind, "text": _words(event)}
        for event in reversed(events[-N_EVENTS:])
    ]


def _words(event: Event) -> str:
    if event.kind != TRANSITION:
        return event.text
    state, reason = str(event.data.get("to")), str(event.data.get("reason"))
    return f"Now {state.replace('_', ' ')}, because: {reason}. That means: {STATES.get(state, state)}."
