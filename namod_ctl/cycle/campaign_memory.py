"""What a campaign's store says about the cycles so far."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from namod_ctl.core.clock import Clock
from namod_ctl.cycle.convergence import Measurement
from namod_ctl.cycle.plan import Plan
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle
from namod_ctl.store.run import RunStore

NOTE_FORECASTS = "forecasts"


def cycle_to_record(store: CampaignStore) -> Cycle:
    """The cycle that the next records belong to: the last one while it has no estimate, else a new one."""
    cycles = store.cycles()
    if cycles and cycles[-1].alignment_json is None:
        return cycles[-1]
    number = store.begin_cycle()
    return next(cycle for cycle in store.cycles() if cycle.number == number)


def open_run(store: CampaignStore, cycle: Cycle, facet_ids: Sequence[int], clock: Clock) -> RunStore:
    """The run of a cycle, open for writing; begun if it does not exist yet."""
    path = store.run_path(cycle.number)
    if path.exists():
        return RunStore.open(path, read_only=False)
    source = f"cycle {cycle.number} of {store.path.name}"
    return RunStore.create(path, facet_ids, store.config_json, source, clock)


def alignments_on_record(
    store: CampaignStore, alignment_from_json: Callable[[str, str], Alignment]
) -> dict[int, Alignment]:
    """Alignments that are on record, by number of their cycle."""
    return {
        cycle.number: alignment_from_json(cycle.alignment_json, f"cycle {cycle.number}")
        for cycle in store.cycles()
        if cycle.alignment_json is not None
    }


def note_forecast(store: CampaignStore, number: int, plan: Plan) -> None:
    """Keep how certain the forecast of a cycle's correction is; the forecast itself is in the cycle's row."""
    store.set_note(f"{NOTE_FORECASTS}.{number}", repr(plan.forecast.uncertainty_rad2))


def history_of(store: CampaignStore, last: Cycle, plan: Plan) -> list[Measurement]:
    """Measurements since the campaign began, or since the last correction that was taken back."""
    measured = [cycle for cycle in store.cycles() if cycle.number < last.number] + [last]
    undone_in = {
        int(number)
        for event in store.events()
        if event.kind == "undone_in" and isinstance(number := event.data.get("cycle"), int)
    }
    first = max(undone_in, default=0)
    history = []
    for cycle in measured:
        if cycle.number <= first or not math.isfinite(cycle.a_sigma_now_rad2):
            continue
        doubt = float(store.note(f"{NOTE_FORECASTS}.{cycle.number}") or "nan")
        history.append(Measurement.of(cycle, doubt))
    if history:
        history[-1] = replace(history[-1], possible=plan.possible, is_trying=bool(plan.tried))
    return history
