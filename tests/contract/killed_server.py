"""A recording with both cameras on one server of others, which is killed in the middle of it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "unit/cycle"))
sys.path.append(str(Path(__file__).parents[1] / "unit/imaging"))
sys.path.append(str(Path(__file__).parents[1] / "unit/reconstruction"))

from foreign_programs import ForeignServer
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, STAR_SIZE_RAD, hexagon, instrument, resized
from recorded_night import accepted, bits

from namod_ctl.core.clock import SystemClock, SystemMonotonicClock
from namod_ctl.core.interfaces import Camera
from namod_ctl.core.records import Record
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.devices.cameras.lifeline import Lifeline
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.run import RunStore

COLUMNS, ROWS = 160, 120
N_BEFORE, N_WANTED = 4, 9
_FACETS = {1: hexagon(40.3, 40.2, 22.0), 2: hexagon(110.3, 60.2, 30.0)}
_NO_CONFIG = '{"telescope": {"name": "TEST"}}'
_GIVE_UP_S = 60.0


@dataclass
class Recording:
    """What came of it.

    Attributes
    ----------
    before
        The records that were stored when the server was killed.
    troubles
        What the crew was told.
    """

    star_model: CameraModel
    star: Lifeline
    reflector: Lifeline
    reason: str = ""
    before: list[Record] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)

    @property
    def accepted(self) -> list[Record]:
        """The records that count."""
        return accepted(self.records)


def record_through_a_kill(
    path: Path,
    server: ForeignServer,
    open_camera: Callable[[str], Camera],
    star_fwhm_px: float,
    full_scale_adu: float,
    *,
    comes_back: bool,
) -> Recording:
    """Record; kill the server; once the crew was told, start it again, or stop by hand.

    Parameters
    ----------
    open_camera
        Opens the camera of a role.
    """
    clock = SystemMonotonicClock()
    scale_rad = STAR_SIZE_RAD / star_fwhm_px
    star_model = replace(resized(STAR_CAMERA, COLUMNS, ROWS), full_scale_adu=full_scale_adu, plate_scale_rad=scale_rad)
    reflector_model = replace(resized(REFLECTOR_CAMERA, COLUMNS, ROWS), full_scale_adu=full_scale_adu)
    cameras = {role: Lifeline(lambda role=role: open_camera(role), clock) for role in ("star", "reflector")}
    done = Recording(star_model, cameras["star"], cameras["reflector"])
    settings = RecordSettings(region_radius_rad=math.radians(0.12), fetch_timeout_s=2.0, longest_s=0.3)
    with RunStore.create(path, tuple(_FACETS), _NO_CONFIG, "a simulator's sky", SystemClock()) as store:
        equipment = Equipment(done.star, done.reflector, clock, SystemClock())
        recorder = Recorder(equipment, instrument(star_model, reflector_model, _FACETS), store, settings)
        is_over = False

        def watch(progress: Progress) -> None:
            nonlocal is_over
            if progress.n_accepted >= N_BEFORE and not done.before:
                done.before = store.records()
                server.kill()
            elif done.before and not is_over and "lost" in progress.source.trouble:
                done.troubles.append(progress.source.trouble)
                is_over = True
                if comes_back:
                    server.start()
                else:
                    recorder.ask_to_stop()

        done.reason = recorder.record(StopRule(n_records=N_WANTED, duration_s=_GIVE_UP_S), watch)
        done.records = store.records()
    return done


def assert_nothing_lost(done: Recording) -> None:
    """What was stored when the server died is there, bit by bit, and what follows goes on from it."""
    assert len(accepted(done.before)) >= N_BEFORE
    assert [bits(record) for record in done.records[: len(done.before)]] == [bits(record) for record in done.before]
    assert [record.index for record in done.records] == list(range(len(done.records)))
