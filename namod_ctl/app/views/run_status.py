"""How the recording of a run stands, as any other terminal can see it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from namod_ctl.app.views.number_ranges import counted
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.recording_control import pid_at_work
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.store.run import RunStore

RUN_SCHEMA = "namod-run-status/1"


def describe_run(store: RunStore) -> dict[str, Any]:
    """Everything that `status` says of a run, as it goes into JSON; what is not known is None.

    Raises StoreError when the run cannot be read.
    """
    n_counting = sum(record.reject_reason is None for record in store.records())
    text = store.note(NOTE_LIVE)
    live = None if text is None else LiveStatus.from_json(text)
    pid = pid_at_work(store.path)
    if pid is None and is_campaign(store.path.parent):  # one process records all runs of a campaign
        pid = pid_at_work(store.path.parent)
    is_recorded = pid is not None and live is not None and not live.ended
    return {
        "schema": RUN_SCHEMA,
        "run": str(store.path),
        "source": store.source,
        "is_recorded": is_recorded,
        "process": (pid or None) if is_recorded else None,
        "n_records": n_counting,
        "n_wanted": None if live is None else live.n_wanted,
        "rate_per_min": live.rate_per_min if live is not None and math.isfinite(live.rate_per_min) else None,
        "n_retaken": None if live is None else sum(live.dropped.values()),
        "trouble": "" if live is None else live.warning or live.trouble,
        "waits_for": live.waits_for if is_recorded and live is not None else "",
        "ended": "" if live is None else live.ended,
        "has_live_status": live is not None,
    }


def run_lines(standing: Mapping[str, Any]) -> list[str]:
    """The same for a person."""
    wanted = "" if standing["n_wanted"] is None else f" of {standing['n_wanted']} wanted"
    rate = f", {standing['rate_per_min']:.0f} per minute" if standing["rate_per_min"] is not None else ""
    retaken = f", {counted(standing['n_retaken'], 'frame')} retaken" if standing["n_retaken"] else ""
    records = f"{standing['n_records']}{wanted}" if wanted else counted(standing["n_records"], "record")
    lines = [
        f"{standing['run']}: a run, {standing['source']}",
        f"Records: {records}{rate}{retaken}",
        f"Running: {_process(standing)}",
    ]
    if standing["trouble"]:
        lines.append(f"Trouble: {standing['trouble']}")
    if standing["waits_for"]:
        lines.append(f"Waits:   for {standing['waits_for']}")
    if standing["ended"]:
        lines.append(f"Ended:   {standing['ended']}")
    elif standing["has_live_status"] and not standing["is_recorded"]:
        lines.append("Ended:   without a word, as when it is killed; every record it had stored is there")
    if standing["is_recorded"]:
        lines.append(f"Next:    it goes on by itself; 'namod-ctl stop {standing['run']}' ends it in order")
    else:
        lines.append(f"Next:    'namod-ctl reconstruct {standing['run']}'")
    return lines


def _process(standing: Mapping[str, Any]) -> str:
    if not standing["is_recorded"]:
        return "no, nobody records into it"
    return f"process {standing['process']} records into it" if standing["process"] else "yes, it is recorded just now"
