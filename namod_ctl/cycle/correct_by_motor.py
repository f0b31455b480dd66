"""Corrections by motors: orders are on record before they are sent, and none is lost or carried out twice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import NamodError, SafetyStop
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import m_to_mm
from namod_ctl.cycle.correct import StopAsked
from namod_ctl.cycle.learned_wiring import LearnedWiring
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.plan import Plan, plan_correction
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import JournaledOrder

_N_SHOWN = 5
_N_ASKED_AGAIN = 3


class MotorCorrector:
    """Turns facets with the drives of a mover. See `correct.Corrector`."""

    are_people = False
    can_undo = True

    def __init__(
        self,
        store: CampaignStore,
        instrument: Instrument,
        mover: Mover,
        drives: Mapping[Leg, Drive],
        settings: MotionSettings,
        clock: MonotonicClock,
    ) -> None:
        self._store, self._instrument = store, instrument
        self._mover, self._drives, self._settings = mover, drives, settings
        self._clock = clock
        self._learned = LearnedWiring(instrument.mounts, max(drive.resolution_m for drive in drives.values()))

    @property
    def has_learned(self) -> bool:
        """Did the last correction show drives that are not what the config says?"""
        return self._learned.has_news

    def check(self) -> list[str]:
        """Drives that are not well, a line each."""
        states = self._mover.read_states()
        remarks = [f"{leg}: {trouble}" for leg, state in states.items() if (trouble := _trouble(state))]
        if len(remarks) == len(states):
            raise SafetyStop(f"none of {len(states)} drives can move: {'; '.join(remarks[:_N_SHOWN])}")
        return remarks

    def recover(self, poll: Callable[[], None]) -> None:
        """Read back what unfinished orders came to, and bring those to their end that stopped on their way."""
        unfinished = self._store.unfinished_orders()
        if not unfinished:
            return
        states = self._standing([journaled.order.leg for journaled in unfinished], poll)
        rest: list[tuple[JournaledOrder, float]] = []
        strangers = []
        for journaled in unfinished:
            order = journaled.order
            state = states.get(order.leg, "it has no drive any more")
            if isinstance(state, str) or not state.is_homed or math.isnan(state.position_m):
                why = state if isinstance(state, str) else "it has lost its reference"
                self._store.result(
                    journaled.id, MoveResult(order, MoveOutcome.LOST, math.nan, f"after a restart: {why}")
                )
            elif abs(state.position_m - order.target_m) <= self._settings.arrival_tolerance_m:
                found = MoveResult(order, MoveOutcome.ARRIVED, state.position_m, "found at its target after a restart")
                self._store.result(journaled.id, found)
            elif self._is_on_its_way(order, state.position_m):
                rest.append((journaled, state.position_m))
            else:
                detail = f"after a restart it stands at {m_to_mm(state.position_m):+.3f} mm, where no order sent it"
                self._store.result(journaled.id, MoveResult(order, MoveOutcome.UNKNOWN, state.position_m, detail))
                strangers.append(f"{order.leg} {detail}")
        if strangers:
            raise SafetyStop(f"{'; '.join(strangers[:_N_SHOWN])}: look at it, then release")
        if rest:
            ids = {journaled.order.leg: journaled for journaled, _ in rest}
            orders = [MoveOrder(j.order.leg, position_m, j.order.target_m) for j, position_m in rest]

            def finish(result: MoveResult) -> None:
                journaled = ids[result.order.leg]
                self._store.result(
                    journaled.id, MoveResult(journaled.order, result.outcome, result.readback_m, result.detail)
                )

            self._mover.execute(orders, finish, poll)

    def learn(self, alignments: Mapping[int, Alignment]) -> list[str]:
        """Compare what was ordered with what was seen, over all corrections so far."""
        return self._learned.learn(self._travels(), alignments)

    def plan(self, result: Reconstruction) -> Plan:
        """The correction, from where the drives stand now."""
        states = self._read_patiently()
        failed = self._failed_facets()
        trials = {facet_id: travels for facet_id, travels in self._learned.trials().items() if facet_id not in failed}
        return plan_correction(
            result,
            self._learned.travels,
            states,
            self._drives,
            self._settings,
            {**self._learned.disabled, **failed},
            trials,
        )

    def changed_since(self, plan: Plan) -> str:
        """Drives that stand elsewhere than when the plan was made."""
        states = self._read_patiently([order.leg for order in plan.orders])
        for order in plan.orders:
            state = states[order.leg]
            trouble = _trouble(state)
            if trouble:
                return f"{order.leg}: {trouble}"
            assert isinstance(state, DriveState)
            moved_m = state.position_m - order.start_m
            if abs(moved_m) > self._settings.arrival_tolerance_m:
                return f"{order.leg} has moved by {m_to_mm(moved_m):+.4f} mm since the preview"
        return ""

    def carry_out(self, cycle: int, plan: Plan, poll: Callable[[], None]) -> str:
        """Journal the orders, then send them."""
        return self._execute(cycle, plan.orders, poll)

    def undo(self, cycle: int, poll: Callable[[], None]) -> str:
        """Send the legs of the cycle before back to where they stood."""
        states = self._mover.read_states()
        orders = []
        for journaled in self._store.orders(cycle - 1):
            state = states.get(journaled.order.leg)
            if isinstance(state, DriveState) and not _trouble(state):
                orders.append(MoveOrder(journaled.order.leg, state.position_m, journaled.order.start_m))
        summary = self._execute(cycle, orders, poll)
        self._store.add_event("undone_in", summary, {"cycle": cycle})
        return summary

    def instruct(self, cycle: int, run: Path, plan: Plan) -> str:
        """Motors need no sheets: a bug of the caller."""
        raise NotImplementedError

    def mark_done(self, facet_ids: Sequence[int] | Literal["all"]) -> str:
        """For a person who thinks that bolts are turned by hand here."""
        return "this campaign turns facets by motors; there is nothing to mark"

    def is_done(self) -> bool:
        """Motors are never waited for by marks: a bug of the caller."""
        raise NotImplementedError

    def stop(self, reason: str) -> None:
        """Send stop to all drives."""
        try:
            self._mover.stop_all(reason)
        except (NamodError, OSError):
            return  # every drive that could be reached was told; the reason for the stop matters more

    def _read_patiently(self, legs: Sequence[Leg] | None = None) -> dict[Leg, DriveState | str]:
        """States of drives, None: all; one that does not answer is asked again before its facet is left out for it."""
        states = self._mover.read_states(legs)
        for _ in range(_N_ASKED_AGAIN):
            silent = [leg for leg, state in states.items() if isinstance(state, str)]
            if silent:
                states |= self._mover.read_states(silent)
        return states

    def _execute(self, cycle: int, orders: Sequence[MoveOrder], poll: Callable[[], None]) -> str:
        ids = dict(zip((order.leg for order in orders), self._store.order(cycle, orders), strict=True))
        results = self._mover.execute(orders, lambda result: self._store.result(ids[result.order.leg], result), poll)
        counts = Counter(result.outcome for result in results)
        if counts[MoveOutcome.STOPPED]:
            raise StopAsked("motion was stopped")
        failed = [
            f"{result.order.leg}: {result.detail}" for result in results if result.outcome is not MoveOutcome.ARRIVED
        ]
        text = f"{counts[MoveOutcome.ARRIVED]} of {len(orders)} legs arrived"
        return text if not failed else f"{text}; {'; '.join(failed[:_N_SHOWN])}"

    def _standing(self, legs: Sequence[Leg], poll: Callable[[], None]) -> Mapping[Leg, DriveState | str]:
        """State of the drives when none moves any more: one that was under way at a crash goes on to its target."""
        while True:
            states = self._mover.read_states([leg for leg in legs if leg in self._drives])
            if not any(isinstance(state, DriveState) and state.is_moving for state in states.values()):
                return states
            poll()
            self._clock.wait_s(self._settings.poll_s)

    def _is_on_its_way(self, order: MoveOrder, position_m: float) -> bool:
        """Between where it was and where it was sent, the one-sided approach from below included."""
        tolerance_m = self._settings.arrival_tolerance_m
        low_m = min(order.start_m, order.target_m - self._settings.approach_m) - tolerance_m
        high_m = max(order.start_m, order.target_m) + tolerance_m
        return low_m <= position_m <= high_m

    def _failed_facets(self) -> dict[int, str]:
        """Facets a leg of which did not arrive when it was last ordered to."""
        last = {journaled.order.leg: journaled for journaled in self._store.orders()}
        return {
            leg.facet_id: f"leg {leg.index + 1} {journaled.result.outcome.value}: {journaled.result.detail}"
            for leg, journaled in last.items()
            if journaled.result is not None and journaled.result.outcome in _OUT
        }

    def _travels(self) -> dict[int, dict[Leg, float]]:
        """Travel of the drives, m, in every cycle that ordered any: from readback to readback."""
        travels: dict[int, dict[Leg, float]] = {}
        for journaled in self._store.orders():
            readback_m = math.nan if journaled.result is None else journaled.result.readback_m
            of_cycle = travels.setdefault(journaled.cycle, {})
            of_cycle[journaled.order.leg] = (
                of_cycle.get(journaled.order.leg, 0.0) + readback_m - journaled.order.start_m
            )
        return travels


_OUT = (MoveOutcome.OFF_TARGET, MoveOutcome.FAULT, MoveOutcome.LOST)
"""Outcomes after which a facet is left alone: a person must look."""


def _trouble(state: DriveState | str) -> str:
    """Why a drive cannot be moved; empty when it can."""
    if isinstance(state, str):
        return state
    if state.faults:
        return ", ".join(state.faults)
    if not state.is_homed or not np.isfinite(state.position_m):
        return "it is not homed: namod-ctl actuators home"
    return ""
