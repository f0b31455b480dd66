"""The closed loop: record, reconstruct, correct, until the area of the point spread function has converged.

What to do next is told by the state machine (`machine`); this module does it. Everything that must be remembered is
in the campaign's store before it is done, so that a campaign can be taken up after any kill.
"""

from __future__ import annotations

from dataclasses import replace

from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError, DataQualityError, NamodError, SafetyStop
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign_memory import alignments_on_record, cycle_to_record, history_of, note_forecast, open_run
from namod_ctl.cycle.campaign_parts import CampaignSettings, Outside, View
from namod_ctl.cycle.control import OF_FACETS, ControlBox, Request, RequestKind
from namod_ctl.cycle.convergence import Decision, decide
from namod_ctl.cycle.correct import Corrector, StopAsked
from namod_ctl.cycle.machine import FINAL, CampaignMachine
from namod_ctl.cycle.plan import Plan
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.psf_check import AT_FIRST, check_psf, was_checked
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.cycle.turn_marks import FacetIds, left, unmark
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction, reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle
from namod_ctl.store.run import RunStore

MAX_POOR_RECORDINGS = 2
"""So often a recording that is unusable as a whole is repeated."""

MAX_CHANGED_PREVIEWS = 3

MIN_COVERAGE = 0.8
"""Of the region: a recording that was interrupted has gaps, and facets whose light falls there are known badly."""

LISTENING = frozenset({"recording", "paused", "awaiting_approval", "awaiting_operator"})
"""States that answer requests themselves."""


_TOO_LATE = "not possible now: somebody has stopped it"


class Campaign:
    """Works on a campaign that is open for writing, in one thread.

    Parameters
    ----------
    corrector
        Turn the facets: motors or people.
    switch
        Thrown by whoever wants all motion to stop.
    """

    def __init__(
        self,
        store: CampaignStore,
        instrument: Instrument,
        corrector: Corrector,
        outside: Outside,
        settings: CampaignSettings,
        clock: Clock,
        switch: StopSwitch,
        view: View,
    ) -> None:
        self._store, self._instrument, self._corrector = store, instrument, corrector
        self._outside, self._settings, self._clock = outside, settings, clock
        self._switch, self._view = switch, view
        self._control = ControlBox(store.path)
        self._machine = CampaignMachine(store.last_state() or "idle", self._journal)
        self._result: Reconstruction | None = None
        self._plan: Plan | None = None
        self._n_poor = self._n_changed = 0

    @property
    def state(self) -> str:
        """Where the campaign stands."""
        return self._machine.state

    def run(self) -> str:
        """Work until a final state; that state.

        Raises
        ------
        StoreError, and whatever interrupts the program; all motion is stopped then and the campaign is held.
        """
        try:
            self._corrector.recover(self._poll)
            self._learn_again()
            if self.state == "awaiting_operator":
                self._remind()
            while self.state not in FINAL:
                state = self.state
                self._view.state(state, "")
                getattr(self, f"_in_{state}")()
                if state not in LISTENING and self.state not in LISTENING:
                    self._poll()
        except (StopAsked, SafetyStop, DataQualityError) as stop:
            self._hold(str(stop))
            if isinstance(stop, StopAsked):  # who stops it does not want to wait for a camera
                return self.state
        except KeyboardInterrupt as stop:
            self._hold(f"stopped by {stop}" if str(stop) else "stopped by Ctrl-C")
            raise
        except BaseException as error:
            self._hold(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
            raise
        check_psf(self._store, self._outside.psf_equipment, f"in the end ({self.state})", self._view.told)
        return self.state

    # -- the states -------------------------------------------------------------------------------------------------

    def _in_idle(self) -> None:
        self._machine.fire("start", "asked for")

    def _in_checking(self) -> None:
        remarks = self._corrector.check()
        for remark in remarks:
            self._tell("check", remark)
        cycles = self._store.cycles()
        asked = self._store.turns()
        if cycles and asked and asked[0].cycle == cycles[-1].number and not all(turns.is_done for turns in asked):
            self._machine.fire("wait", "people have not turned all that they were asked for")
            self._remind()
        else:
            self._machine.fire("ready", f"checked; {len(remarks)} remarks")

    def _in_recording(self) -> None:
        cycle = cycle_to_record(self._store)
        with open_run(self._store, cycle, self._instrument.reflector.ids, self._clock) as run:
            recorder = Recorder(self._outside.equipment(), self._instrument, run, self._settings.record)

            def on_progress(progress: Progress) -> None:
                self._view.recording(cycle.number, progress)
                for request in self._requests():
                    if request.kind is RequestKind.PAUSE:
                        recorder.ask_to_stop()
                        self._control.answer(request, "paused at the next record")
                        self._machine.fire("pause", "asked for")
                    else:
                        self._refuse(request)

            wanted = self._settings.n_records * (1 + self._n_poor)  # once more as many where they did not suffice
            reason = recorder.record(StopRule(n_records=wanted, min_coverage=MIN_COVERAGE), on_progress)
            n_accepted = recorder.progress().n_accepted
        self._store.save_cycle(replace(cycle, n_records=n_accepted))
        if self.state == "recording":
            self._machine.fire("recorded", f"cycle {cycle.number}: {n_accepted} records, {reason}")

    def _in_paused(self) -> None:
        for request in self._requests():
            if request.kind is RequestKind.RESUME:
                self._control.answer(request, "recording goes on")
                self._machine.fire("resume", "asked for")
                return
            self._refuse(request)
        self._view.wait()

    def _in_reconstructing(self) -> None:
        cycle = self._store.cycles()[-1]
        try:
            result = self._reconstructed(cycle)
        except DataQualityError as error:
            self._record_again(str(error))
            return
        for finding in self._corrector.learn(self._alignments()):
            self._tell("finding", finding)
        plan = self._corrector.plan(result)
        cycle = replace(
            cycle,
            a_sigma_now_rad2=result.alignment.now.a_sigma_rad2,
            a_sigma_uncertainty_rad2=result.alignment.now.uncertainty_rad2,
            a_sigma_predicted_rad2=plan.forecast.a_sigma_rad2,
            a_sigma_limit_rad2=self._settings.limit_rad2 or result.limit.a_sigma_rad2,
            alignment_json=self._outside.alignment_to_json(result.alignment),
        )
        note_forecast(self._store, cycle.number, plan)
        history = history_of(self._store, cycle, plan)
        decision, why = decide(history, self._settings.limit_rad2, self._settings.max_cycles)
        if decision is Decision.VAGUE:
            self._record_again(why)
            return
        if decision is Decision.WORSE and not self._n_poor and not self._corrector.has_learned:
            # nobody knows why: gaps in the pointings look alike, and undoing a good correction costs more than a look
            self._record_again(f"{why}; a longer look must confirm it")
            return
        self._n_poor = 0
        self._store.save_cycle(replace(cycle, decision=f"{decision.value}: {why}"))
        self._view.measured(self._store.cycles()[-1], result)
        match decision:
            case Decision.CONVERGED:
                self._machine.fire("converge", why)
            case Decision.WORSE:
                self._after_worse(why)
            case Decision.TOO_MANY:
                raise SafetyStop(why)
            case Decision.STUCK:
                kept = [f"facet {number}: {text}" for number, text in plan.refused.items()]
                raise SafetyStop("; ".join([why, *kept]))
            case Decision.CORRECT:
                if not was_checked(self._store, AT_FIRST):
                    check_psf(self._store, self._outside.psf_equipment, AT_FIRST, self._view.told)
                self._machine.fire("correct", why)

    def _in_previewing(self) -> None:
        result = self._result or self._reconstructed(self._store.cycles()[-1])
        self._plan = self._corrector.plan(result)
        number = self._store.cycles()[-1].number
        for facet_id, why in self._plan.refused.items():
            data = {"cycle": number, "facet_id": facet_id, "leg": None, "why": why}
            self._store.add_event("refused", f"facet {facet_id}: {why}", data)
        self._view.plan(self._plan)
        if not self._plan.turned and not self._plan.tried:
            raise SafetyStop(f"no facet can be turned: {next(iter(self._plan.refused.values()), 'there are none')}")
        if self._corrector.are_people:
            self._machine.fire("instruct", f"{len(self._plan.turned)} facets to turn by hand")
        elif self._settings.is_asked:
            self._machine.fire("ask", f"{len(self._plan.orders)} legs of {len(self._plan.turned)} facets would move")
        else:
            self._machine.fire("approve", "approved beforehand")

    def _in_awaiting_approval(self) -> None:
        if self._plan is None:
            self._machine.fire("changed", "restarted while a person was asked: it is worked out and shown again")
            return
        answer = self._view.answer()
        for request in self._requests():
            if request.kind in (RequestKind.APPROVE, RequestKind.REFUSE):
                answer = request.kind is RequestKind.APPROVE
                self._control.answer(request, "approved" if answer else "refused: nothing moves")
            else:
                self._refuse(request)
        if answer is None:
            self._view.wait()
        elif answer:
            self._machine.fire("approve", "approved by a person")
        else:
            raise SafetyStop("the correction was refused by a person; nothing has moved")

    def _in_correcting(self) -> None:
        if self._plan is None:
            # a restart: orders on record were brought to an end by `recover`; without any, nothing has moved yet
            cycle = self._store.cycles()[-1]
            if self._store.orders(cycle.number):
                self._machine.fire("corrected", "the orders of before the restart are done")
            else:
                self._machine.fire("changed", "restarted before anything was ordered")
            return
        changed = self._corrector.changed_since(self._plan)
        if changed:
            self._n_changed += 1
            if self._n_changed > MAX_CHANGED_PREVIEWS:
                raise SafetyStop(f"the drives do not stand still: {changed}")
            self._plan = None
            self._machine.fire("changed", changed)
            return
        plan, self._plan, self._n_changed = self._plan, None, 0
        summary = self._corrector.carry_out(self._store.cycles()[-1].number, plan, self._poll)
        self._machine.fire("corrected", summary)

    def _in_undoing(self) -> None:
        summary = self._corrector.undo(self._store.cycles()[-1].number, self._poll)
        if not self._corrector.has_learned:
            raise SafetyStop(f"the last correction made it worse and was taken back ({summary}); nobody knows why")
        self._machine.fire("corrected", f"{summary}; what was learned may mend it")

    def _in_instructing(self) -> None:
        plan = self._plan or self._corrector.plan(self._result or self._reconstructed(self._store.cycles()[-1]))
        cycle = self._store.cycles()[-1]
        self._tell("instructions", self._corrector.instruct(cycle.number, self._store.run_path(cycle.number), plan))
        self._machine.fire("wait", "sheets are written")

    def _in_awaiting_operator(self) -> None:
        for request in self._requests():
            if request.kind in OF_FACETS:
                self._mark(request.facet_ids, request)
            else:
                self._refuse(request)
        if marked := self._view.turned():
            self._mark(marked)
        if self._corrector.is_done():
            self._plan = None
            self._machine.fire("done", "all facets are marked as done")
        else:
            self._view.wait()

    # -- helpers ----------------------------------------------------------------------------------------------------

    def _remind(self) -> None:
        """People who turn bolts: where their sheets are, and what is left."""
        where = [event.text for event in self._store.events() if event.kind == "instructions"][-1:]
        for text in [*where, left(self._store)]:
            self._view.told(text)

    def _mark(self, facet_ids: FacetIds, request: Request | None = None) -> None:
        """Write down what people say of their bolts, or take it back, and answer the request it came with."""
        is_undo, is_accepted = request is not None and request.kind is RequestKind.NOT_DONE, True
        try:
            answer = unmark(self._store, facet_ids) if is_undo else self._corrector.mark_done(facet_ids)
        except ConfigError as error:
            answer, is_accepted = str(error), False
        if request is not None:
            self._control.answer(request, answer, is_accepted=is_accepted)
        self._view.told(answer)

    def _learn_again(self) -> None:
        """After a restart: what the corrections so far have taught, in the two last steps of before.

        Without it a plan would be made with the config's wiring, where the program knew better already.
        """
        known = alignments_on_record(self._store, self._outside.alignment_from_json)
        if self.state == "reconstructing":  # the last cycle is learned from there
            known.pop(self._store.cycles()[-1].number, None)
        for n_known in range(max(len(known) - 1, 1), len(known) + 1):
            self._corrector.learn(dict(sorted(known.items())[:n_known]))

    def _record_again(self, why: str) -> None:
        """Once more as many records in the same cycle, a bounded number of times. Raises DataQualityError."""
        self._n_poor += 1
        if self._n_poor > MAX_POOR_RECORDINGS:
            raise DataQualityError(f"{why}; it stayed so in {self._n_poor} recordings")
        self._machine.fire("poor_data", why)

    def _after_worse(self, why: str) -> None:
        if self._corrector.are_people and self._corrector.has_learned:
            self._machine.fire("correct", f"{why}; new sheets go from where the facets are now")
            return
        n_undone = sum(event.data.get("trigger") == "undo" for event in self._store.events())
        if n_undone or not self._corrector.can_undo:
            raise SafetyStop(f"{why}; {'it was undone once already' if n_undone else 'people must look'}")
        self._machine.fire("undo", why)

    def _reconstructed(self, cycle: Cycle) -> Reconstruction:
        path = self._store.run_path(cycle.number)
        with RunStore.open(path, read_only=False) as run:
            result = reconstruct(tabulate_responses(run.records(), run.facet_ids), self._instrument)
            alignment_json = self._outside.alignment_to_json(result.alignment)
            run.save_estimate(result.alignment.estimator, alignment_json, self._clock)
        self._outside.write_results(path, result)
        self._result = result
        return result

    def _alignments(self) -> dict[int, Alignment]:
        """Alignments of all cycles that have one, the present one included, by number."""
        assert self._result is not None
        return alignments_on_record(self._store, self._outside.alignment_from_json) | {
            self._store.cycles()[-1].number: self._result.alignment
        }

    def _requests(self) -> list[Request]:
        """Requests from elsewhere; one that asks to stop is obeyed here.

        Raises StopAsked.
        """
        if self._switch.is_thrown:
            raise StopAsked(self._switch.reason)
        requests = self._control.poll()
        for complaint in self._control.complaints():
            self._tell("control", complaint)
        if stops := [request for request in requests if request.kind is RequestKind.STOP]:
            self._switch.throw("stopped by `namod-ctl stop`")
            for request in requests:
                is_stop = request in stops
                text = "stopping: the campaign is held until somebody releases it" if is_stop else _TOO_LATE
                self._control.answer(request, text, is_accepted=is_stop)
            raise StopAsked(self._switch.reason)
        return requests

    def _poll(self) -> None:
        """Look for requests where only a stop can be meant."""
        for request in self._requests():
            self._refuse(request)

    def _refuse(self, request: Request) -> None:
        why = f"not possible now: {request.kind.replace('_', ' ')} means nothing in state {self.state}"
        self._control.answer(request, why, is_accepted=False)

    def _hold(self, reason: str) -> None:
        """Stop all motion, then journal it: in this order, as the disk may be the trouble."""
        self._switch.throw(reason)
        self._corrector.stop(reason)
        try:
            if self.state not in FINAL:
                self._machine.fire("hold", reason)
                self._view.state(self.state, reason)
        except NamodError as error:
            self._view.told(f"this could not be journaled: {error}")

    def _tell(self, kind: str, text: str) -> None:
        self._store.add_event(kind, text)
        self._view.told(text)

    def _journal(self, source: str, trigger: str, destination: str, reason: str) -> None:
        self._store.add_transition(source, destination, trigger, reason)
