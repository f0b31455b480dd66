"""What a campaign remembers, as values: events, cycles, orders and their results, turns asked of a person."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult

Json: TypeAlias = "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None"

TRANSITION = "transition"
"""Kind of the events that are steps of the state machine; their data: `from`, `to`, `trigger`, `reason`."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened.

    Attributes
    ----------
    id
        Counts up from 1 in the order in which events were committed.
    time_utc
        ISO 8601, by the clock of the campaign.
    data
        For programs; NaN has become None.
    """

    id: int
    time_utc: str
    kind: str
    text: str
    data: Mapping[str, Json] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Cycle:
    """One cycle: what was recorded and what came of it. NaN: not known, or not yet.

    Attributes
    ----------
    number
        From 1.
    run_folder
        Name of the run's folder inside the campaign's.
    a_sigma_now_rad2, a_sigma_uncertainty_rad2
        Area of the whole reflector's PSF as recorded in this cycle.
    a_sigma_predicted_rad2
        What this cycle's correction should make of it.
    a_sigma_limit_rad2
        What a perfectly aligned reflector would show.
    alignment_json
        The estimate as in `alignment.json`; None before there is one.
    decision
        For a person: what is done next and why; empty while the cycle goes on.
    """

    number: int
    run_folder: str
    n_records: int = 0
    a_sigma_now_rad2: float = math.nan
    a_sigma_uncertainty_rad2: float = math.nan
    a_sigma_predicted_rad2: float = math.nan
    a_sigma_limit_rad2: float = math.nan
    alignment_json: str | None = None
    decision: str = ""


@dataclass(frozen=True, slots=True)
class JournaledOrder:
    """An order as journaled; `result` None: it was meant to be carried out, whether it was nobody has read back."""

    id: int
    cycle: int
    order: MoveOrder
    result: MoveResult | None


@dataclass(frozen=True, slots=True)
class AskedTurns:
    """Turns of one facet's bolts that a person was asked for.

    Attributes
    ----------
    turns_deg
        One per bolt, signed as on the instruction sheets.
    is_done
        Somebody said that they are done.
    """

    cycle: int
    facet_id: int
    turns_deg: tuple[float, ...]
    is_done: bool


def real(value: object) -> float:
    """A number in a row; NULL is NaN."""
    return math.nan if value is None else float(str(value))


def event_of(row: Sequence[object]) -> Event:
    """The event in a row of its id, time, kind, text and data."""
    event_id, time_utc, kind, text, data_json = row
    return Event(int(str(event_id)), str(time_utc), str(kind), str(text), json.loads(str(data_json)))


def order_of(row: Sequence[object], database: Path) -> JournaledOrder:
    """The order in a row of its id, cycle, facet, leg, start, target, and its result's outcome, readback and detail.

    Raises StoreError for an unknown outcome.
    """
    order_id, cycle, facet_id, leg_index, start_m, target_m, outcome, readback_m, detail = row
    order = MoveOrder(Leg(int(str(facet_id)), int(str(leg_index))), real(start_m), real(target_m))
    result = None
    if outcome is not None:
        try:
            result = MoveResult(order, MoveOutcome(str(outcome)), real(readback_m), str(detail))
        except ValueError:
            raise StoreError(
                f"{database}: order {order_id} has the unknown outcome {outcome!r}; update namod-ctl"
            ) from None
    return JournaledOrder(int(str(order_id)), int(str(cycle)), order, result)


def target_of(order: MoveOrder) -> float:
    """The order's target. Raises ValueError when it is none."""
    if not math.isfinite(order.target_m):
        raise ValueError(f"{order.leg}: {order.target_m} m is no target")
    return float(order.target_m)


def without_nan(value: Json) -> Json:
    """The same, with None for NaN and infinite numbers."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None  # numpy's float64 is a float
    if isinstance(value, Mapping):
        return {str(key): without_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(each) for each in value]
    return value
