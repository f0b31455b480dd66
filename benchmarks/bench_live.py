"""What it costs a recording, and a correction, that other programs can watch: status, pictures, states of legs.

Run: python benchmarks/bench_live.py [n_records [folder]]

Frames of FACT's size are recorded in wall time, without a pause and with exposures of 0.2 s. Beside the time of each
part stands its share of the recording's; the measuring thread has it, while the cameras' threads expose. Limit: 2 %.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench_record import RealClock, StoredFrames, make_frames

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.cycle.live_status import LiveNote, LivePictures
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.run import RunStore

LIMIT_SHARE = 0.02
EXPOSURES_S = (0.0, 0.2)
LEGS = (9, 90, 3000)
PARTS = {
    "status with a record": (LiveNote, "with_record"),
    "status by itself": (LiveNote, "tell"),
    "pictures": (LivePictures, "show"),
    "store, all of it": (RunStore, "append"),
}


def timed(spent_s: list[float], call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    began = time.perf_counter()
    result = call(*arguments, **options)
    spent_s.append(time.perf_counter() - began)
    return result


def main() -> None:
    n_records = int(sys.argv[1]) if len(sys.argv) > 1 else 150
    folder = sys.argv[2] if len(sys.argv) > 2 else None
    config = load_config("fact")
    instrument = build_instrument(config)
    ids = [facet.id for facet in config.facets]
    star, reflector = make_frames(instrument, ids)
    spent_s: dict[str, list[float]] = {name: [] for name in PARTS}
    for name, (owner, method) in PARTS.items():
        call = getattr(owner, method)
        setattr(owner, method, lambda *a, _call=call, _spent=spent_s[name], **o: timed(_spent, _call, *a, **o))
    print(f"{'exposure':>9} {'part':>22} {'calls':>6} {'median of those that do anything':>33} {'share':>8}")
    for exposure_s in EXPOSURES_S:
        for times in spent_s.values():
            times.clear()
        cameras = StoredFrames("star", star, exposure_s / 4.0), StoredFrames("reflector", reflector, exposure_s)
        with tempfile.TemporaryDirectory(dir=folder) as place:
            store = RunStore.create(Path(place) / "RUN", ids, config.to_json(), "benchmark", SystemClock())
            settings = RecordSettings(max_motion_share=1e9, shortest_s=1e-6)
            with store:
                recorder = Recorder(Equipment(*cameras, RealClock(), SystemClock()), instrument, store, settings)
                took: list[float] = []
                timed(took, recorder.record, StopRule(n_records=n_records))
        for name, times in spent_s.items():
            worked_ms = [1e3 * t for t in times if t > 50e-6] or [0.0]
            share = sum(times) / took[0]
            verdict = "" if name.startswith("store") else "ok" if share <= LIMIT_SHARE else "TOO MUCH"
            median_ms = np.median(worked_ms)
            print(f"{exposure_s:7.2f} s {name:>22} {len(worked_ms):6} {median_ms:30.2f} ms {share:8.2%} {verdict}")
    print(f"\n{'legs at once':>12} {'show':>9} {'read':>9}")
    state = DriveState(1e-3, True, True, (), 300.0)
    with (
        tempfile.TemporaryDirectory(dir=folder) as place,
        CampaignStore.create(Path(place) / "CAMPAIGN", "{}", "benchmark", SystemClock()) as campaign,
    ):
        for n_legs in LEGS:
            heard = {Leg(n // 3, n % 3): state for n in range(n_legs)}
            shown, read = list[float](), list[float]()
            for _ in range(20):
                timed(shown, partial(campaign.show_legs, heard))
                timed(read, campaign.seen_legs)
            print(f"{n_legs:12} {1e3 * np.median(shown):6.2f} ms {1e3 * np.median(read):6.2f} ms")


if __name__ == "__main__":
    main()
