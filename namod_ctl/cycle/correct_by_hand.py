"""Corrections by people: sheets with bolt turns, marks of what is done, and a check of it in the next cycle."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.units import rad_to_deg
from namod_ctl.cycle.manual import TurnKind, check_turns
from namod_ctl.cycle.plan import Plan, forecast
from namod_ctl.cycle.turn_marks import mark
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment
from namod_ctl.reconstruction.reconstruct import Reconstruction, turning_cov_rad2
from namod_ctl.store.campaign import CampaignStore

_NOTE_TOLD = "marks_told"


class ManualCorrector:
    """Asks people to turn bolts. See `correct.Corrector`.

    Parameters
    ----------
    write_sheets
        Writes the instructions of an alignment into its run's folder; says for a person what is where.
    goniometer_sigma_rad
        How well a person sets a turn, one standard deviation.
    on_done
        Told of every facet that is newly marked, and its turns; the twin's bolts are turned by it.
    """

    are_people = True
    can_undo = False

    def __init__(
        self,
        store: CampaignStore,
        instrument: Instrument,
        write_sheets: Callable[[Path, Alignment], str],
        goniometer_sigma_rad: float,
        on_done: Callable[[int, Sequence[float]], None] = lambda facet_id, turns_deg: None,
    ) -> None:
        self._store, self._instrument = store, instrument
        self._write_sheets, self._goniometer_sigma_rad = write_sheets, goniometer_sigma_rad
        self._on_done = on_done
        self._result: Reconstruction | None = None
        self.has_learned = False
        """Did the last call of `learn` find slips of people, which the next sheets make good?"""

    def check(self) -> list[str]:
        """People are there or not; nobody can be asked."""
        return []

    def recover(self, poll: Callable[[], None]) -> None:
        """Turns asked for are on record; facets may have been marked while the program did not run."""
        self._tell_of_marks()

    def learn(self, alignments: Mapping[int, Alignment]) -> list[str]:
        """Facet by facet, whether the turns that were asked for are what was done."""
        self.has_learned = False
        if len(alignments) < 2:
            return []
        before, after = (alignments[number] for number in sorted(alignments)[-2:])
        asked = {
            turns.facet_id: np.array(turns.turns_deg)
            for turns in self._store.turns(sorted(alignments)[-2])
            if turns.is_done  # of the others nobody said that they were turned
        }
        if not asked:
            return []
        was, is_now = (
            {facet.facet_id: (facet.theta_rad, facet.theta_cov_rad2) for facet in alignment.facets}
            for alignment in (before, after)
        )
        findings = check_turns(self._instrument.mounts, asked, was, is_now, self._goniometer_sigma_rad)
        kinds = Counter(finding.kind for finding in findings if finding.facet_id in asked)
        mistakes = [finding for finding in findings if finding.kind.is_mistake]
        # where nearly all are turned the other way it is no slip: the config or the sheets are read wrongly
        self.has_learned = bool(mistakes) and kinds[TurnKind.WRONG_DIRECTION] <= len(asked) / 2
        summary = f"{kinds[TurnKind.RIGHT]} of {len(asked)} facets were turned as asked"
        if kinds[TurnKind.TOO_SMALL]:
            summary += f"; of {kinds[TurnKind.TOO_SMALL]} facets nothing can be told, as their turns were small"
        n_unseen = len(asked) - kinds.total()
        if n_unseen:
            summary += f"; {n_unseen} were not seen before or after"
        return [summary, *(finding.sentence for finding in mistakes)]

    def plan(self, result: Reconstruction) -> Plan:
        """Facets that people are to turn; their turns follow in `instruct`."""
        self._result = result
        turned, refused = [], {}
        for facet in result.alignment.facets:
            if (
                facet.flags.forbids_turning
                or not np.isfinite(facet.bolt_turn_deg).all()
                or not len(facet.bolt_turn_deg)
            ):
                refused[facet.facet_id] = _reason(facet)
            elif np.any(self._rounded_deg(facet)):
                turned.append(facet.facet_id)
        return Plan((), tuple(turned), refused, forecast(result, turned, self._turning_cov_rad2))

    def changed_since(self, plan: Plan) -> str:
        """People see for themselves."""
        return ""

    def carry_out(self, cycle: int, plan: Plan, poll: Callable[[], None]) -> str:
        """No motors here: a bug of the caller."""
        raise NotImplementedError

    def undo(self, cycle: int, poll: Callable[[], None]) -> str:
        """No motors here: a bug of the caller."""
        raise NotImplementedError

    def instruct(self, cycle: int, run: Path, plan: Plan) -> str:
        """Write the sheets and journal the turns that are asked for, rounded as a goniometer can set them."""
        assert self._result is not None
        facets = {facet.facet_id: facet for facet in self._result.alignment.facets}
        turns = {facet_id: self._rounded_deg(facets[facet_id]).tolist() for facet_id in plan.turned}
        self._store.ask_turns(cycle, turns)
        return self._write_sheets(run, self._result.alignment)

    def mark_done(self, facet_ids: Sequence[int] | Literal["all"]) -> str:
        """Mark facets; the answer names them, and those that are left."""
        answer = mark(self._store, facet_ids)
        self._tell_of_marks()
        return answer

    def is_done(self) -> bool:
        """Are all facets that were asked for marked?"""
        return all(turns.is_done for turns in self._store.turns())

    def stop(self, reason: str) -> None:
        """Nothing moves by itself."""

    def _tell_of_marks(self) -> None:
        """Tell `on_done` of marked facets, of each at most once.

        Neither a kill in between turns a bolt twice, nor a mark that is taken back and made again.
        """
        marked = [turns for turns in self._store.turns() if turns.is_done]
        if not marked:
            return
        key = f"{_NOTE_TOLD}.{marked[0].cycle}"
        told = set(json.loads(self._store.note(key) or "[]"))
        self._store.set_note(key, json.dumps(sorted(told | {turns.facet_id for turns in marked})))
        for turns in marked:
            if turns.facet_id not in told:
                self._on_done(turns.facet_id, turns.turns_deg)

    def _turning_cov_rad2(self, facet_id: int) -> NDArray[np.float64]:
        return turning_cov_rad2(self._instrument.mounts[facet_id], self._instrument.goniometer_resolution_rad)

    def _rounded_deg(self, facet: FacetAlignment) -> NDArray[np.float64]:
        step_deg = rad_to_deg(self._instrument.goniometer_resolution_rad)
        return np.asarray(np.round(facet.bolt_turn_deg / step_deg) * step_deg)


def _reason(facet: FacetAlignment) -> str:
    names = [flag for flag in FacetFlag if flag & facet.flags and flag.forbids_turning]
    return (
        "; ".join(f"{flag.name}: {FACET_FLAG_MEANING[flag]}" for flag in names)
        or "it has no bolts, or no turn is known"
    )
