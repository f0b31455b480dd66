"""The correction that waits for approval: which leg goes how far, what stays as it is and why, what is to be won."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from namod_ctl.app.dashboard.numbers import short
from namod_ctl.core.drives import Leg
from namod_ctl.core.units import m_to_mm, rad2_to_arcmin2
from namod_ctl.cycle.learned_wiring import LearnedWiring
from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign_rows import Cycle, Event, JournaledOrder

ASKING = "awaiting_approval"


def preview(cycle: Cycle, question: str, refused: Mapping[int, str], travels_m: Mapping[Leg, float]) -> dict[str, Any]:
    """What a person is asked to approve.

    Parameters
    ----------
    question
        The campaign's own words, which count the legs and facets.
    refused
        Facets that stay as they are, and why.
    travels_m
        From `planned_travels`.
    """
    legs = {
        leg: {"facet": leg.facet_id, "leg": leg.index + 1, "travel_mm": short(m_to_mm(travel_m))}
        for leg, travel_m in sorted(travels_m.items())
    }
    farthest = max(legs, key=lambda leg: abs(travels_m[leg]), default=None)
    return {
        "cycle": cycle.number,
        "question": question,
        "area_now": short(rad2_to_arcmin2(cycle.a_sigma_now_rad2)),
        "area_predicted": short(rad2_to_arcmin2(cycle.a_sigma_predicted_rad2)),
        "legs": list(legs.values()),
        "largest": None if farthest is None else legs[farthest],
        "refused": _by_reason(refused),
    }


def refused_in(events: Sequence[Event]) -> dict[int, str]:
    """Facets that the latest preview leaves as they are, and why."""
    refused: dict[int, str] = {}
    for event in events:
        if event.data.get("to") == "previewing":
            refused = {}
        elif event.kind == "refused":
            refused[int(str(event.data["facet_id"]))] = str(event.data["why"])
    return refused


def planned_travels(
    mounts: Mapping[int, Mount],
    alignments: Mapping[int, Alignment],
    orders: Sequence[JournaledOrder],
    refused: Mapping[int, str],
    resolution_m: float,
) -> dict[Leg, float]:
    """Travel, m, along +z of every leg that would move: as the campaign works it out, from what it works it out from.

    Parameters
    ----------
    alignments
        By number of their cycle; the correction of the last one is asked about.
    orders
        Of the whole campaign: drives that turned out to be wired otherwise than the config says go other ways.
    resolution_m
        A travel of less than half of it is no move.
    """
    wiring = LearnedWiring(mounts, resolution_m)
    went_m = _travels_by_cycle(orders)
    if went_m:
        for n_known in range(2, len(alignments) + 1):
            wiring.learn(went_m, dict(sorted(alignments.items())[:n_known]))
    found: dict[Leg, float] = {}
    for facet in alignments[max(alignments)].facets:
        if facet.facet_id not in refused:
            found |= wiring.travels(facet)
    for facet_id, trial_m in wiring.trials().items():
        if _IS_TRIED in refused.get(facet_id, ""):
            found |= trial_m
    return {leg: travel_m for leg, travel_m in found.items() if abs(travel_m) >= resolution_m / 2.0}


_IS_TRIED = "a small move tries"
"""Of the words with which a plan says so of a facet that stays as it is otherwise."""


def _travels_by_cycle(orders: Sequence[JournaledOrder]) -> dict[int, dict[Leg, float]]:
    """How far each drive went after each cycle's recording, m, from readback to readback."""
    travels: dict[int, dict[Leg, float]] = defaultdict(dict)
    for journaled in orders:
        order, result = journaled.order, journaled.result
        went_m = (math.nan if result is None else result.readback_m) - order.start_m
        of_cycle = travels[journaled.cycle]
        of_cycle[order.leg] = of_cycle.get(order.leg, 0.0) + went_m
    return dict(travels)


def _by_reason(refused: Mapping[int, str]) -> list[dict[str, Any]]:
    """Reasons with their facets, the most frequent first."""
    found: dict[str, list[int]] = defaultdict(list)
    for facet_id, why in refused.items():
        found[why].append(facet_id)
    return [{"why": why, "facets": ids} for why, ids in sorted(found.items(), key=lambda item: -len(item[1]))]
