"""Dead time between exposures and memory of the recorder: frames of FACT's size through the whole path, in wall time.

Run: python benchmarks/bench_record.py [n_records]

Two cameras that take real time to expose give frames that were rendered before. Dead time is what passes from the end
of the longer exposure to the start of the next, the frames' judgement and the choice of the next exposure included;
beside it the time that measuring and storing a record takes, which would be added to it in a loop without threads.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.imaging.exposure import frame_statistics
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record
from namod_ctl.store.run import RunStore

LIMIT_SHARE, LIMIT_S = 0.02, 0.020
EXPOSURES_S = (0.05, 0.2, 1.0)
N_FRAMES = 20
N_MEMORY = 10_000
RADIUS_PX = 60.0


class RealClock:
    """The computer's monotonic clock."""

    def monotonic_s(self) -> float:
        return time.monotonic()

    def wait_s(self, duration_s: float) -> None:
        time.sleep(duration_s)


@dataclass
class StoredFrames:
    """A camera that shows frames in turn, `exposure_s` after they are asked for, whatever is asked for."""

    name: str
    frames: list[np.ndarray]
    exposure_s: float
    exposure_range_s: tuple[float, float] = (1e-6, 3.0)
    started: list[float] = field(default_factory=list)
    ended: list[float] = field(default_factory=list)

    def start(self, exposure_s: float) -> None:
        self.started.append(time.monotonic())

    def fetch(self, timeout_s: float) -> Exposure:
        end = self.started[-1] + self.exposure_s
        time.sleep(max(0.0, end - time.monotonic()))
        self.ended.append(time.monotonic())
        n = len(self.ended)
        return Exposure(self.frames[n % len(self.frames)], max(self.exposure_s, 1e-3), end - self.exposure_s / 2, n)

    def close(self) -> None:
        pass


def main() -> None:
    n_records = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    config = load_config("fact")
    instrument = build_instrument(config)
    ids = [facet.id for facet in config.facets]
    star, reflector = make_frames(instrument, ids)
    print("one by one, as a loop without threads would: ", end="")
    photometer = FacetPhotometer(instrument.facet_polygons_px, ids, 1024, 768)
    began = time.monotonic()
    for n in range(N_FRAMES):
        measure_record(star[n], reflector[n], 0.05, 0.2, instrument, photometer, n, "")
    measuring_ms = (time.monotonic() - began) / N_FRAMES * 1e3
    began = time.monotonic()
    for n in range(N_FRAMES):
        frame_statistics(star[n], instrument.star_camera)
    judging_ms = (time.monotonic() - began) / N_FRAMES * 1e3
    print(f"measuring {measuring_ms:.1f} ms, judging a star frame {judging_ms:.1f} ms")
    print(f"{'exposure':>9} {'dead time median':>17} {'95 %':>8} {'limit':>8}")
    for exposure_s in EXPOSURES_S:
        camera, _ = run(instrument, config.to_json(), ids, star, reflector, exposure_s, n_records)
        dead_ms = 1e3 * np.sort([s - e for e, s in zip(camera.ended, camera.started[1:], strict=False)])
        limit_ms = 1e3 * max(LIMIT_SHARE * exposure_s, LIMIT_S)
        worst = dead_ms[int(0.95 * len(dead_ms))]
        verdict = "ok" if worst <= limit_ms else "TOO LONG"
        print(f"{exposure_s:7.2f} s {np.median(dead_ms):14.1f} ms {worst:5.1f} ms {limit_ms:5.0f} ms  {verdict}")
    _, memory = run(instrument, config.to_json(), ids, star, reflector, 0.0, N_MEMORY)
    early, late = memory[1000], memory[-1]
    print(f"memory after 1000 records {early:.0f} MiB, after {N_MEMORY} {late:.0f} MiB")


def make_frames(instrument, ids) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Noisy frames with a star that wanders and facets that shine, bright enough to be kept as they are."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:1920, :2560].astype(np.float32)
    star, reflector = [], []
    for n in range(N_FRAMES):
        x0, y0 = 1280 + RADIUS_PX * np.cos(0.3 * n), 960 + RADIUS_PX * np.sin(0.3 * n)
        light = 190.0 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2.0 * 4.36**2))
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        star.append(np.clip(light + 3.0 + noise, 0, 255).astype(np.uint8))
        dish = 3.0 + 0.6 * rng.standard_normal((768, 1024, 3), dtype=np.float32)
        for facet_id in ids[::2]:
            left, top = instrument.facet_polygons_px[facet_id].min(axis=0).astype(int)
            dish[top : top + 100, left : left + 100] += 60.0 + 6.0 * (n + facet_id) % 130
        reflector.append(np.clip(dish, 0, 255).astype(np.uint8))
    return star, reflector


def run(instrument, config_json, ids, star, reflector, exposure_s, n_records) -> tuple[StoredFrames, list[float]]:
    """The camera with the longer exposures after a recording, and the memory in use after every record, MiB."""
    cameras = StoredFrames("star", star, exposure_s / 4.0), StoredFrames("reflector", reflector, exposure_s)
    memory: list[float] = []

    def note_memory(progress: Progress) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        memory.append(pages * resource.getpagesize() / 2**20)

    with tempfile.TemporaryDirectory() as folder:
        store = RunStore.create(Path(folder) / "RUN", ids, config_json, "benchmark", SystemClock())
        settings = RecordSettings(max_motion_share=1e9, shortest_s=1e-6)
        clock = RealClock()
        with store:
            recorder = Recorder(Equipment(*cameras, clock, SystemClock()), instrument, store, settings)
            recorder.record(StopRule(n_records=n_records), note_memory)
    return cameras[1], memory


if __name__ == "__main__":
    main()
