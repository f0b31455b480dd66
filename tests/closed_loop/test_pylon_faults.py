"""Faults of Basler cameras, made by the maker's own emulation, befall a recording: it goes on, and loses no record."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from campaign_rig import SEED, SETTINGS, small_config

from namod_ctl.app.build import bench_sky
from namod_ctl.app.build.bench_sky import twin_equipment
from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.twin import build_twin
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import DeviceFaultError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.devices.cameras.pylon_camera import PylonCamera
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.store.run import RunStore

pytest.importorskip("pypylon.pylon", reason="pypylon is not installed: pip install 'namod-ctl[pylon]'")

N_RECORDS = 24
BEFALLEN_AT = 8
"""Records after which the fault begins."""
N_BAD = 3
"""Fewer in a row than make a camera count as lost."""
N_BAD_FOR_GOOD = 1000


@dataclass
class Bench:
    """A recording on the bench, its cameras in the order in which they were opened, and what the crew was told."""

    recorder: Recorder
    store: RunStore
    cameras: list[PylonCamera]
    is_unplugged: threading.Event
    troubles: list[str] = field(default_factory=list)

    def of(self, role: str) -> PylonCamera:
        """The camera of that role that was opened last."""
        return [camera for camera in self.cameras if camera.name.startswith(role)][-1]

    def record(self, befall: Callable[[Bench], None], enough_troubles: int | None = None) -> str:
        """Record, let the fault in on the way, and stop at last or when so many different troubles were told."""
        is_befallen = False

        def watch(progress: Progress) -> None:
            nonlocal is_befallen
            if progress.n_accepted >= BEFALLEN_AT and not is_befallen:
                is_befallen = True
                befall(self)
            if progress.source.trouble and progress.source.trouble not in self.troubles:
                self.troubles.append(progress.source.trouble)
            if enough_troubles is not None and len(self.troubles) >= enough_troubles:
                self.recorder.ask_to_stop()

        return self.recorder.record(StopRule(n_records=N_RECORDS), watch)

    def dropped(self, cause: DropCause) -> int:
        return self.recorder.progress().source.dropped.get(cause, 0)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    cameras: list[PylonCamera] = []
    is_unplugged = threading.Event()

    def open_camera(settings: CameraSettings, clock: MonotonicClock) -> PylonCamera:
        if is_unplugged.is_set():  # the emulation cannot make its list shorter
            raise DeviceFaultError(f"{settings.role} camera: no Basler camera found")
        cameras.append(PylonCamera(settings, clock))
        return cameras[-1]

    monkeypatch.setenv("PYLON_CAMEMU", "2")
    monkeypatch.setattr(bench_sky, "PylonCamera", open_camera)
    with _store(tmp_path / "RUN") as (store, recorder):
        del cameras[:-2]  # those that were opened to see whether they can be
        yield Bench(recorder, store, cameras, is_unplugged)


@contextmanager
def _store(path: Path) -> Iterator[tuple[RunStore, Recorder]]:
    config = small_config("bench_pylon")
    twin = build_twin(config, SETTINGS, SEED)
    facet_ids = [facet.id for facet in config.facets]
    with (
        twin_equipment(config, twin) as open_equipment,
        RunStore.create(path, facet_ids, config.to_json(), "bench", SystemClock()) as store,
    ):
        yield store, Recorder(open_equipment(), twin.instrument, store, build_record_settings(config))


def assert_complete(bench: Bench, path: Path, n_records: int = N_RECORDS) -> None:
    """Every record that was counted is on the disk, measured, and in its place."""
    with RunStore.open(path) as stored:
        records = stored.records()
    assert [record.index for record in records] == list(range(len(records)))
    accepted = [record for record in records if record.reject_reason is None]
    assert len(accepted) == n_records
    assert all(np.isfinite(record.facet_intensity).all() for record in accepted)


def fail_buffers(camera: PylonCamera, count: int) -> None:
    camera.device.ForceFailedBufferCount.SetValue(count)
    camera.device.ForceFailedBuffer.Execute()


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_bad_buffers_are_dropped_and_the_pairs_taken_again(bench: Bench, tmp_path: Path, role: str) -> None:
    reason = bench.record(lambda bench: fail_buffers(bench.of(role), N_BAD))
    assert reason == "all records wanted are there"
    assert bench.dropped(DropCause.NO_FRAME) == N_BAD
    assert len(bench.cameras) == 2  # nobody was opened anew for that
    assert_complete(bench, tmp_path / "RUN")


def test_a_camera_that_delivers_bad_buffers_only_is_opened_anew(bench: Bench, tmp_path: Path) -> None:
    reason = bench.record(lambda bench: fail_buffers(bench.of("star"), N_BAD_FOR_GOOD))
    assert reason == "all records wanted are there"
    assert bench.dropped(DropCause.CAMERA_LOST) > 0
    assert [camera.name.split()[0] for camera in bench.cameras] == ["star", "reflector", "star"]
    assert_complete(bench, tmp_path / "RUN")


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_a_camera_that_vanishes_and_comes_back_is_used_again(bench: Bench, tmp_path: Path, role: str) -> None:
    reason = bench.record(lambda bench: bench.of(role).device.FirePnPCallback.Execute())
    assert reason == "all records wanted are there"
    assert bench.dropped(DropCause.CAMERA_LOST) > 0
    assert [camera.name.split()[0] for camera in bench.cameras] == ["star", "reflector", role]
    assert_complete(bench, tmp_path / "RUN")


def test_a_camera_that_stays_away_holds_the_recording_which_says_so(bench: Bench, tmp_path: Path) -> None:
    def pull_the_plug(bench: Bench) -> None:
        bench.is_unplugged.set()
        bench.of("reflector").device.FirePnPCallback.Execute()

    assert bench.record(pull_the_plug, enough_troubles=2) == "stopped by hand"
    told = bench.troubles[-1]
    assert "reflector camera Basler Emulation (0815-0001)" in told
    assert all(word in told for word in ("lost", "no Basler camera found", "cable")), told
    assert bench.recorder.progress().n_accepted < N_RECORDS
    assert_complete(bench, tmp_path / "RUN", bench.recorder.progress().n_accepted)
