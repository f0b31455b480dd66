"""A recording with two real drivers and a program that is none of ours behind each: frames of the twin's sky, taken
when they are asked for, as files. In real time, as drivers live in it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from frame_program import FrameProgram, Write, write_fits, write_png

from namod_ctl.app.build_recording import build_record_settings
from namod_ctl.app.build_sky_session import open_sky_session
from namod_ctl.app.build_twin import build_twin
from namod_ctl.app.config import load_config
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.twin.camera import TwinCamera
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin

CLOCK = SystemMonotonicClock()
N_RECORDS = 6
SMALL = """
extends = "mini_fact"
[star_camera]
columns = 400
rows = 320
[reflector_camera]
columns = 256
rows = 192
plate_scale_mdeg_per_px = 240.0
"""
DEEPENED = 16
"""Factor between the twin's 8 bit and the 12 bit of the star camera here."""


class TwinProgram(FrameProgram):
    """Takes its pixels from a twin's camera, in real time."""

    def __init__(self, folder: Path, camera: TwinCamera, twin: Twin, begun_s: float, write: Write, factor: int) -> None:
        super().__init__(folder, np.zeros((1, 1), dtype=np.uint8), write, is_stubborn=False)
        self._camera, self._twin, self._begun_s, self._factor = camera, twin, begun_s, factor

    def expose(self, exposure_s: float) -> np.ndarray:
        self._twin.update(CLOCK.monotonic_s() - self._begun_s)
        self._camera.start(exposure_s)
        CLOCK.wait_s(exposure_s)
        image = self._camera.fetch(1.0).image
        return image if self._factor == 1 else image.astype(np.uint16) * self._factor


def write_config(folder: Path, twin: Twin) -> str:
    """The small telescope with the folders as cameras, and its facets' outlines."""
    text = SMALL.replace("[star_camera]\n", "[star_camera]\nfull_scale_adu = 4095\n")
    for role in ("star", "reflector"):
        (folder / role).mkdir()
        text += f'[{role}_camera.device]\ndriver = "folder"\naddress = "{role}"\nexposure_range_s = [0.001, 3.0]\n'
    for facet_id, corners_px in twin.instrument.facet_polygons_px.items():
        text += f"[[reflector_map.polygons]]\nfacet_id = {facet_id}\ncorners_px = {corners_px.tolist()}\n"
    (folder / "telescope.toml").write_text(text)
    return str(folder / "telescope.toml")


def test_a_recording_from_folders_sees_the_star_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    twin = build_twin(load_config(tmp_path / "small.toml"), TwinSettings(), seed=1)
    config_name = write_config(tmp_path, twin)
    begun_s = CLOCK.monotonic_s()
    with ExitStack() as stack:
        for role, camera, write, factor in (
            ("star", twin.star_camera, write_fits, DEEPENED),
            ("reflector", twin.reflector_camera, write_png, 1),
        ):
            stack.enter_context(TwinProgram(tmp_path / role, camera, twin, begun_s, write, factor))
        session = open_sky_session(stack, tmp_path / "run", None, config_name, force=False)
        assert session is not None
        settings = build_record_settings(session.config)
        recorder = Recorder(session.equipment, session.instrument, session.store, settings)
        run_begun_s = CLOCK.monotonic_s() - begun_s
        recorder.record(StopRule(n_records=N_RECORDS, duration_s=60.0))
        records = [record for record in session.store.records() if record.reject_reason is None]
    assert len(records) == N_RECORDS
    seen_rad = np.array([record.theta_rad for record in records])
    true_rad = np.array([twin.true_star_theta_rad(r.star_mid_exposure_s + run_begun_s) for r in records])
    assert np.ptp(true_rad, axis=0).max() > 1e-4  # it has moved
    # in 50 ms, more than the way through the file system takes, the star moves by 1.5e-5; the rest is its measurement
    assert seen_rad == pytest.approx(true_rad, abs=4e-5)
    assert all(np.isfinite(record.facet_intensity).sum() >= 1 for record in records)
    assert max(abs(record.mid_exposure_difference_s) for record in records) < 0.05
    assert not list(tmp_path.glob("*/request.json"))
