"""Moves by a look-up table: every leg goes to an absolute place, reckoned from where it stood when it was aligned.

Where that was, and at which zenith distance, is on record in a journal, which is a campaign's folder of its own. So a
table that is applied twice moves nothing, and one that is applied after another one leaves no trace of that.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TypeGuard

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import deg_to_rad, m_to_mm, rad_to_deg
from namod_ctl.cycle.leg_course import refusal
from namod_ctl.store.campaign import CampaignStore

NOTE_JOURNAL = "lut.journal"
"""Holds what moves: "twin" or "telescope"; campaigns that are no journal have no such note."""
NOTE_BASELINE = "lut.baseline"
NOTE_APPLIED = "lut.applied"


@dataclass(frozen=True, slots=True)
class Baseline:
    """The alignment that the table starts from.

    Attributes
    ----------
    zenith_rad
        At which the facets were aligned as they stand.
    position_m
        Where their legs stood then.
    after_cycle
        Number of the journal's last move before.
    """

    zenith_rad: float
    position_m: Mapping[Leg, float]
    after_cycle: int


@dataclass(frozen=True, slots=True)
class TablePlan:
    """What a table would do: orders, facets that they turn, and facets that stay and why."""

    orders: tuple[MoveOrder, ...]
    turned: tuple[int, ...]
    refused: Mapping[int, str]


def noted_baseline(store: CampaignStore) -> Baseline | None:
    """The baseline on record; None where none was ever taken. Raises StoreError for one that cannot be understood."""
    text = store.note(NOTE_BASELINE)
    if text is None:
        return None
    try:
        noted = json.loads(text)
        positions = {Leg(int(f), int(i)): float(m) for f, i, m in noted["positions_m"]}
        return Baseline(deg_to_rad(float(noted["zenith_deg"])), positions, int(noted["after_cycle"]))
    except (ValueError, KeyError, TypeError) as problem:
        raise StoreError(
            f"{store.path}: the alignment noted there cannot be understood ({problem}); align anew, and name another "
            "--journal"
        ) from None


def take_baseline(store: CampaignStore, zenith_rad: float, states: Mapping[Leg, DriveState | str]) -> Baseline:
    """The legs as they stand become the baseline. Drives that are not well have none: their facets stay out."""
    positions = {leg: state.position_m for leg, state in states.items() if _is_known(state)}
    after_cycle = max((cycle.number for cycle in store.cycles()), default=0)
    noted = {
        "zenith_deg": rad_to_deg(zenith_rad),
        "positions_m": [[leg.facet_id, leg.index, position_m] for leg, position_m in positions.items()],
        "after_cycle": after_cycle,
    }
    store.set_note(NOTE_BASELINE, json.dumps(noted))
    note_zenith(store, zenith_rad)
    store.add_event(
        "lut_baseline", f"aligned at {rad_to_deg(zenith_rad):g} deg from zenith: {len(positions)} legs as they stand"
    )
    return Baseline(zenith_rad, positions, after_cycle)


def note_zenith(store: CampaignStore, zenith_rad: float | None) -> None:
    """Note for which zenith distance the facets stand; None while they are on their way, or were halted there."""
    store.set_note(NOTE_APPLIED, json.dumps(None if zenith_rad is None else rad_to_deg(zenith_rad)))


def noted_zenith_deg(store: CampaignStore) -> float | None:
    """What `note_zenith` noted last."""
    noted = json.loads(store.note(NOTE_APPLIED) or "null")
    return None if noted is None else float(noted)


def moved_legs(
    store: CampaignStore, baseline: Baseline, states: Mapping[Leg, DriveState | str], tolerance_m: float
) -> list[str]:
    """Legs that stand elsewhere than where the table, or the alignment before it, left them; a line for each."""
    expected = dict(baseline.position_m)
    for journaled in store.orders():
        result = journaled.result
        if journaled.cycle > baseline.after_cycle and result is not None and math.isfinite(result.readback_m):
            expected[journaled.order.leg] = result.readback_m
    return [
        f"{leg} stands at {m_to_mm(state.position_m):+.4f} mm instead of {m_to_mm(expected[leg]):+.4f} mm"
        for leg, state in states.items()
        if leg in expected and _is_known(state) and abs(state.position_m - expected[leg]) > tolerance_m
    ]


def halted_legs(store: CampaignStore) -> frozenset[Leg]:
    """Legs whose last order did not end at its target: they may stand near it, and yet their play is not taken up."""
    last = {journaled.order.leg: journaled.result for journaled in store.orders()}
    return frozenset(leg for leg, result in last.items() if result is None or result.outcome is not MoveOutcome.ARRIVED)


def plan_table_move(
    travels_m: Mapping[Leg, float],
    baseline: Baseline,
    states: Mapping[Leg, DriveState | str],
    drives: Mapping[Leg, Drive],
    settings: MotionSettings,
    halted: Collection[Leg] = (),
) -> TablePlan:
    """Orders that bring each leg `travels_m` from its baseline. A facet moves by all of its legs or not at all.

    Of `halted` legs no way is too short, down to the last step of the drive.
    """
    orders: list[MoveOrder] = []
    refused: dict[int, str] = {}
    turned: list[int] = []
    for facet_id in dict.fromkeys(leg.facet_id for leg in travels_m):
        own = {leg: travel_m for leg, travel_m in travels_m.items() if leg.facet_id == facet_id}
        wanted: list[MoveOrder] = []
        reasons = []
        for leg, travel_m in own.items():
            state = states.get(leg, "no drive is wired to it")
            if isinstance(state, str):
                reasons.append(f"leg {leg.index + 1}: {state}")
            elif leg not in baseline.position_m:
                reasons.append(f"leg {leg.index + 1}: where it stood when it was aligned is not on record")
            else:
                order = MoveOrder(leg, state.position_m, baseline.position_m[leg] + travel_m)
                if words := refusal(order, state, drives[leg], settings):
                    reasons.append(f"leg {leg.index + 1}: {words}")
                wanted.append(order)
        if reasons:
            refused[facet_id] = "; ".join(reasons)
            continue
        moving = [
            order
            for order in wanted
            if abs(order.target_m - order.start_m)
            > _least_way_m(drives[order.leg], settings, was_halted=order.leg in halted)
        ]
        if moving:
            turned.append(facet_id)
            orders += moving
    return TablePlan(tuple(orders), tuple(turned), refused)


def _least_way_m(drive: Drive, settings: MotionSettings, *, was_halted: bool) -> float:
    """A shorter way is none: the drive stands as near to its target as it would after another move."""
    step_m = drive.resolution_m / 2.0
    return step_m if was_halted else max(step_m, settings.arrival_tolerance_m)


def _is_known(state: DriveState | str) -> TypeGuard[DriveState]:
    return isinstance(state, DriveState) and state.is_homed and not state.faults and math.isfinite(state.position_m)
