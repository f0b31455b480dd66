"""The drives' self-test: each leg goes a little way and back, and all others on its bus stand still meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import m_to_mm
from namod_ctl.cycle.mover import Mover

N_NAMED = 4
"""So many legs that moved without being asked are named, the others counted."""


@dataclass(frozen=True, slots=True)
class LegTest:
    """What the self-test found of one leg.

    Attributes
    ----------
    identity
        What the drive says of itself; empty when it does not answer.
    problems
        In words for a person; empty when it passed.
    out_m, back_m
        Readback after the way out and after the way back, less what it should be; NaN when it did not get there.
    n_watched
        So many other drives of the bus were watched meanwhile.
    """

    leg: Leg
    identity: str
    problems: tuple[str, ...]
    out_m: float
    back_m: float
    n_watched: int

    @property
    def has_passed(self) -> bool:
        """Is there nothing wrong with it?"""
        return not self.problems


def self_test(
    mover: Mover,
    legs: Sequence[Leg],
    travel_m: float,
    settings: MotionSettings,
    while_waiting: Callable[[], None],
) -> Iterator[LegTest]:
    """One leg after the other, upwards and back, or downwards where there is no room above.

    The play between spindle and leg is not measured: that takes a position of the leg besides that of the spindle, and
    drives tell one position. After a stop the legs that are left are not tested.

    Parameters
    ----------
    while_waiting
        See `Mover.execute`; what it raises stops everything and is raised here.
    """
    watched = mover.read_states()
    for leg in legs:
        identity = mover.identities([leg])[leg]
        state = watched[leg]
        if isinstance(state, str):
            yield LegTest(leg, identity, (state,), math.nan, math.nan, 0)
            continue
        high_m = mover.range_m(leg)[1]
        target_m = state.position_m + math.copysign(travel_m, high_m - state.position_m - travel_m)
        out = _go(mover, MoveOrder(leg, state.position_m, target_m), while_waiting)
        problems = [] if out.outcome is MoveOutcome.ARRIVED else [f"way out: {out.outcome}: {out.detail}"]
        if out.outcome is MoveOutcome.STOPPED:
            yield LegTest(leg, identity, tuple(problems), math.nan, math.nan, 0)
            return
        back_m, n_watched = math.nan, 0
        if out.outcome in (MoveOutcome.ARRIVED, MoveOutcome.OFF_TARGET):
            back = _go(mover, MoveOrder(leg, out.readback_m, state.position_m), while_waiting)
            back_m = back.readback_m - state.position_m
            if back.outcome is not MoveOutcome.ARRIVED:
                problems.append(f"way back: {back.outcome}: {back.detail}")
        mates = mover.bus_mates(leg)
        after = mover.read_states(mates)
        problems += _unasked(watched, after, settings.arrival_tolerance_m)
        n_watched = sum(_stands(watched[mate]) for mate in mates)
        watched.update(after)
        yield LegTest(leg, identity, tuple(problems), out.readback_m - target_m, back_m, n_watched)


def _go(mover: Mover, order: MoveOrder, while_waiting: Callable[[], None]) -> MoveResult:
    return mover.execute([order], lambda result: None, while_waiting)[0]


def _stands(state: DriveState | str) -> bool:
    return isinstance(state, DriveState) and not state.is_moving


def _unasked(before: dict[Leg, DriveState | str], after: dict[Leg, DriveState | str], tolerance_m: float) -> list[str]:
    """The other drives that have moved, or fell silent."""
    found = []
    for leg, now in after.items():
        then = before[leg]
        if isinstance(then, str):
            continue
        if isinstance(now, str):
            found.append(f"{leg} fell silent")
        elif now.is_moving and not then.is_moving:
            found.append(f"{leg} moves")
        elif abs(now.position_m - then.position_m) > tolerance_m:
            found.append(f"{leg} moved by {m_to_mm(now.position_m - then.position_m):+.4f} mm")
        elif then.is_homed and not now.is_homed:
            found.append(f"{leg} lost its reference")
    if not found:
        return []
    more = f" and {len(found) - N_NAMED} more" if len(found) > N_NAMED else ""
    return [f"meanwhile {', '.join(found[:N_NAMED])}{more}: are two drives set to one address?"]
