"""What a campaign remembers, as values: events, cycles, orders and their results, turns asked of a person."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from namod_ctl.core.motion import MoveOrder, MoveResult

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
