"""What moved: orders to legs and what came of them, or turns asked of people, whether done, and what the star says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from namod_ctl.app.build.correctors import GONIOMETER_SIGMA_RAD
from namod_ctl.app.report.document import Chapter, Table, Text
from namod_ctl.app.report.parts import number_text
from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import m_to_mm, m_to_um
from namod_ctl.cycle.manual import check_turns
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import AskedTurns, JournaledOrder


def motion_chapters(store: CampaignStore, instrument: Instrument, alignments: Mapping[int, Alignment]) -> list[Chapter]:
    """A chapter per cycle in which something was to move."""
    chapters = []
    for cycle in store.cycles():
        if orders := store.orders(cycle.number):
            chapters.append(_move_chapter(cycle.number, orders))
        if turns := store.turns(cycle.number):
            checked = _checked(turns, cycle.number, instrument, alignments)
            chapters.append(_turn_chapter(cycle.number, turns, checked))
    return chapters


def _move_chapter(number: int, orders: list[JournaledOrder]) -> Chapter:
    """A row per facet; a leg that was ordered again has its facet's orders in a further row."""
    rows_of: dict[tuple[int, int], dict[int, JournaledOrder]] = {}
    times: dict[tuple[int, int], int] = {}
    for order in orders:
        leg = order.order.leg
        nth = times[leg.facet_id, leg.index] = times.get((leg.facet_id, leg.index), 0) + 1
        rows_of.setdefault((nth, leg.facet_id), {})[leg.index] = order
    n_legs = 1 + max(order.order.leg.index for order in orders)
    head = ["facet"]
    for leg_number in range(1, n_legs + 1):
        head += [f"leg {leg_number} mm", "left µm"]
    rows = []
    for (_, facet_id), of_leg in sorted(rows_of.items()):
        cells, bad = [str(facet_id)], []
        for index in range(n_legs):
            journaled = of_leg.get(index)
            if journaled is None:
                cells += ["–", "–"]
                continue
            asked, result = journaled.order, journaled.result
            cells.append(number_text(m_to_mm(asked.target_m - asked.start_m), "+.3f"))
            left_m = float("nan") if result is None else asked.target_m - result.readback_m
            cells.append(number_text(m_to_um(left_m), "+.1f"))
            if result is None or result.outcome is not MoveOutcome.ARRIVED:
                bad.append(f"leg {index + 1} {'unknown' if result is None else result.outcome.value.replace('_', ' ')}")
        rows.append((*cells, ", ".join(bad) or "arrived"))
    n_arrived = sum(order.result is not None and order.result.outcome is MoveOutcome.ARRIVED for order in orders)
    words = (
        f"{n_arrived} of {len(orders)} ordered legs arrived. Travels along +z, to the sky, from where the leg stood; "
        "left: target minus what the drive says afterwards."
    )
    table = Table((*head, "outcome"), tuple(rows), frozenset({len(head)}))
    return Chapter(f"Moves in cycle {number}", (Text(words), table))


def _turn_chapter(number: int, turns: list[AskedTurns], checked: Mapping[int, str]) -> Chapter:
    n_bolts = max(len(asked.turns_deg) for asked in turns)
    head = ["facet", *(f"bolt {bolt} deg" for bolt in range(1, n_bolts + 1)), "done", "what the next recording says"]
    rows = tuple(
        (
            str(asked.facet_id),
            *(number_text(turn_deg, "+.0f") for turn_deg in asked.turns_deg),
            *["–"] * (n_bolts - len(asked.turns_deg)),
            "yes" if asked.is_done else "NO",
            checked.get(asked.facet_id, "not seen"),
        )
        for asked in turns
    )
    n_done = sum(asked.is_done for asked in turns)
    words = (
        f"{n_done} of {len(turns)} facets were marked as done. Turns in degrees, positive is clockwise as seen by who "
        "turns."
    )
    return Chapter(f"Bolt turns in cycle {number}", (Text(words), Table(tuple(head), rows, frozenset({n_bolts + 2}))))


def _checked(
    turns: list[AskedTurns], number: int, instrument: Instrument, alignments: Mapping[int, Alignment]
) -> dict[int, str]:
    """What the recording after the turns says of them, by facet; empty while there is none."""
    if number not in alignments or number + 1 not in alignments:
        return {}
    was, is_now = (
        {facet.facet_id: (facet.theta_rad, facet.theta_cov_rad2) for facet in alignments[n].facets}
        for n in (number, number + 1)
    )
    asked = {turn.facet_id: np.array(turn.turns_deg) for turn in turns if turn.is_done}
    findings = check_turns(instrument.mounts, asked, was, is_now, GONIOMETER_SIGMA_RAD)  # as the campaign itself did
    return {
        finding.facet_id: finding.sentence if finding.kind.is_mistake else finding.kind.value.replace("_", " ")
        for finding in findings
    }
