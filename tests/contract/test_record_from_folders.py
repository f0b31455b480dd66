"""A recording with two real drivers and a program that is none of ours behind each: frames of the twin's sky, taken
when they are asked for, as files. In real time, as drivers live in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import typer
from frame_program import FrameProgram, Write, write_fits, write_png
from typer.testing import CliRunner

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.sky_session import open_sky_session
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.commands.record import record
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.store.run import RunStore
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


@dataclass(frozen=True, slots=True)
class Site:
    """A small telescope with a program behind each folder.

    Attributes
    ----------
    begun_s
        When the twin's time was 0, on the computer's clock.
    """

    twin: Twin
    config_name: str
    begun_s: float
    folder: Path


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    (tmp_path / "small.toml").write_text(SMALL)
    twin = build_twin(load_config(tmp_path / "small.toml"), TwinSettings(), seed=1)
    site = Site(twin, write_config(tmp_path, twin), CLOCK.monotonic_s(), tmp_path)
    with (
        TwinProgram(tmp_path / "star", twin.star_camera, twin, site.begun_s, write_fits, DEEPENED),
        TwinProgram(tmp_path / "reflector", twin.reflector_camera, twin, site.begun_s, write_png, 1),
    ):
        yield site


def test_the_star_is_seen_where_it_is(site: Site) -> None:
    with ExitStack() as stack:
        session = open_sky_session(stack, site.folder / "run", None, site.config_name, force=False)
        assert session is not None
        settings = build_record_settings(session.config)
        recorder = Recorder(session.equipment, session.instrument, session.store, settings)
        run_begun_s = CLOCK.monotonic_s() - site.begun_s
        recorder.record(StopRule(n_records=N_RECORDS, duration_s=60.0))
        records = [entry for entry in session.store.records() if entry.reject_reason is None]
    assert len(records) == N_RECORDS
    seen_rad = np.array([entry.theta_rad for entry in records])
    true_rad = np.array([site.twin.true_star_theta_rad(r.star_mid_exposure_s + run_begun_s) for r in records])
    assert np.ptp(true_rad, axis=0).max() > 1e-4  # it has moved
    # in 50 ms, more than the way through the file system takes, the star moves by 1.5e-5; the rest is its measurement
    assert seen_rad == pytest.approx(true_rad, abs=4e-5)
    assert all(np.isfinite(entry.facet_intensity).sum() >= 1 for entry in records)
    assert max(abs(entry.mid_exposure_difference_s) for entry in records) < 0.05
    assert not list(site.folder.glob("*/request.json"))


def test_a_folder_that_goes_and_comes_back_holds_the_recording_meanwhile(site: Site) -> None:
    star, away = site.folder / "star", site.folder / "star_unmounted"
    troubles: list[str] = []

    def on_progress(progress: Progress) -> None:
        if progress.n_accepted == 2 and not troubles and star.exists():
            star.rename(away)
        if progress.source.trouble and not star.exists():
            troubles.append(progress.source.trouble)
            away.rename(star)

    with ExitStack() as stack:
        session = open_sky_session(stack, site.folder / "run", None, site.config_name, force=False)
        assert session is not None
        recorder = Recorder(session.equipment, session.instrument, session.store, build_record_settings(session.config))
        recorder.record(StopRule(n_records=5, duration_s=60.0), on_progress)
        assert [entry.index for entry in session.store.records()] == list(range(5))
    assert len(troubles) == 1
    assert "the folder is gone" in troubles[0]


def test_the_command_records_the_cameras_of_its_config_and_goes_on_with_the_run(site: Site) -> None:
    out = site.folder / "run"
    app = typer.Typer()
    app.command()(record)
    for arguments in (["--config", site.config_name, "--out", str(out)], ["--append", str(out)]):
        n_wanted = "3" if "--out" in arguments else "5"
        result = CliRunner().invoke(app, [*arguments, "--records", n_wanted])
        assert result.exit_code == 0, result.output
        assert f"{n_wanted} records count" in result.output
        assert "twin" not in result.output
    with RunStore.open(out) as store:
        assert str(site.folder / "star") in store.source
        times_s = [entry.star_mid_exposure_s for entry in store.records()]
    assert np.all(np.diff(times_s) > 0.0)
    assert times_s[3] - times_s[2] > 50.0  # another session of the same run
