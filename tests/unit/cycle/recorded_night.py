"""Nights that are recorded, for the tests of the recorder."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from fake_night import TELESCOPE, Night, new_run

from namod_ctl.core.records import Record
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, RecordSettings, StopRule

SETTINGS = RecordSettings(region_radius_rad=math.radians(0.12), store_retry_s=0.0)


def record_night(
    path: Path, night: Night, n_records: int | None, settings: RecordSettings = SETTINGS, minutes: float = 1e9
) -> tuple[list[Record], Recorder, list[Progress]]:
    seen: list[Progress] = []
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, settings)
        recorder.record(StopRule(n_records=n_records, duration_s=60.0 * minutes), seen.append)
        return store.records(), recorder, seen


def accepted(records: Iterable[Record]) -> list[Record]:
    return [record for record in records if record.reject_reason is None]


def bits(record: Record) -> list[object]:
    values = (getattr(record, name) for name in Record.__slots__)
    return [np.asarray(v).tobytes() if isinstance(v, np.ndarray | float) else v for v in values]
