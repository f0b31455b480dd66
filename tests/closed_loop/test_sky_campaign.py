"""A campaign by hand with cameras that a config names: opened anew for every recording, lost, and brought back.

The cameras are drivers that show a twin's sky and, as makers' libraries do, are had by one owner at a time. That a
recording really sees the sky through a driver is tested elsewhere (`test_record_from_folders`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest

from namod_ctl.app.build import cameras as build_cameras
from namod_ctl.app.build.sky_campaign import check_hardware, open_sky_campaign
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import DeviceFaultError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.campaign import MIN_COVERAGE
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.machine import CampaignMachine
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import RecordSettings, StopRule
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.run import RunStore
from namod_ctl.twin.operator import TwinOperator
from namod_ctl.twin.settings import REFLECTOR_CAMERA, STAR_CAMERA, ReflectorSettings, TelescopeSettings, TwinSettings
from namod_ctl.twin.twin import Twin

N_RECORDS = 50
COMPLETE = StopRule(n_records=N_RECORDS, min_coverage=MIN_COVERAGE)
ALIGNED = 1.15
"""Of the limit, and less; unaligned it is four times as much."""

# Six of FACT's facets, and cameras with fewer pixels. Between two records the telescope goes as far as the twin's
# cameras take time, which here is more than passes: how fast it seems is no reason to reject anything.
CONFIG = """
extends = "mini_fact"
[telescope]
name = "Six facets"
focal_length_m = 4.889
[reflector.layout]
width_m = 0.605
spacing_m = 0.620
inner_radius_m = 0.30
outer_radius_m = 0.70
[mount]
radius_m = 0.295
pitch_mm_per_turn = 1.0
travel_limit_mm = 5.0
[recording]
region_radius_deg = 0.2
max_motion_share = 5.0
[star_camera]
columns = 400
rows = 320
[reflector_camera]
columns = 256
rows = 192
plate_scale_mdeg_per_px = 240.0
"""
DEVICES = """
[star_camera.device]
driver = "opencv"
address = "0"
[reflector_camera.device]
driver = "opencv"
address = "1"
"""
SETTINGS = TwinSettings(
    reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(2.5)),
    telescope=TelescopeSettings(
        radius_rad=deg_to_rad(0.2), spacing_rad=arcmin_to_rad(2.4), speed_rad_per_s=arcmin_to_rad(12.0)
    ),
    star_camera=replace(STAR_CAMERA, exposure_at_mag0_s=0.02, latency_s=0.08),
    reflector_camera=replace(REFLECTOR_CAMERA, exposure_at_mag0_s=0.02, latency_s=0.08),
)


class Socket:
    """Where a camera is plugged in: one owner at a time, and somebody may pull the plug."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.is_there = True
        self.owner: PluggedCamera | None = None
        self.n_opened = 0


class PluggedCamera:
    """A driver: the twin's camera, on the computer's clock."""

    def __init__(self, socket: Socket, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._socket, self._clock = socket, clock
        self.name = f"{settings.role} camera (a test's, {settings.address})"
        if not socket.is_there:
            raise DeviceFaultError(f"{self.name}: there is no such camera; check its cable and power")
        if socket.owner is not None:
            raise DeviceFaultError(f"{self.name}: is used by another program; end it")
        socket.owner = self
        socket.n_opened += 1
        self._start_s = 0.0
        self._is_closed = threading.Event()

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        return self._socket.camera.exposure_range_s

    def start(self, exposure_s: float) -> None:
        self._refuse_when_gone()
        self._start_s = self._clock.monotonic_s()
        self._socket.camera.start(exposure_s)

    def fetch(self, timeout_s: float) -> Exposure:
        self._refuse_when_gone()
        exposure = self._socket.camera.fetch(timeout_s)
        return replace(exposure, mid_exposure_s=self._start_s + exposure.exposure_s / 2.0)

    def close(self) -> None:
        self._is_closed.set()
        if self._socket.owner is self:
            self._socket.owner = None

    def _refuse_when_gone(self) -> None:
        if self._is_closed.is_set() or not self._socket.is_there:
            raise DeviceFaultError(f"{self.name}: does not answer")


class Crew(View):
    """Turns the twin's bolts as the sheets ask, then says so; notes what it is told."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self.told_texts: list[str] = []
        self.pulls: str = ""
        """Whose plug is pulled when all bolts are turned."""
        self.is_killed = False
        """The program is, when its recording has become complete and nothing else has been done."""

    def recording(self, cycle: int, progress: Progress) -> None:
        if self.is_killed and COMPLETE.reason_to_stop(progress):
            raise KeyboardInterrupt("a test")

    def told(self, text: str) -> None:
        self.told_texts.append(text)

    def turned(self) -> Sequence[int] | Literal["all"]:
        with CampaignStore.open(self._site.path) as store:
            for turns in store.turns():
                self._site.operator.turn(turns.facet_id, turns.turns_deg)
        if self.pulls:
            self._site.sockets[self.pulls].is_there = False
        return "all"


class Site:
    """The telescope, its cameras' sockets and a campaign on it."""

    def __init__(self, folder: Path, config: InstrumentConfig, twin: Twin) -> None:
        self.config, self.twin = config, twin
        self.path = folder / "CAMPAIGN"
        self.operator = TwinOperator(twin, seed=4)
        self.sockets = {"star": Socket(twin.star_camera), "reflector": Socket(twin.reflector_camera)}
        with CampaignStore.create(self.path, config.to_json(), "a test", SystemClock()):
            pass

    @property
    def ratio_to_limit(self) -> float:
        reflector = self.twin.reflector
        return reflector.a_sigma_now_rad2() / reflector.a_sigma_aligned_rad2()

    def assert_all_is_let_go(self) -> None:
        assert [role for role, socket in self.sockets.items() if socket.owner is not None] == []

    def run(self, crew: Crew) -> str:
        """As `namod-ctl align --resume` does, in a program of its own."""
        with CampaignStore.open(self.path, read_only=False) as store:
            wishes = CampaignSettings(RecordSettings(), N_RECORDS, max_cycles=3)
            clock, switch = SystemClock(), StopSwitch()
            with open_sky_campaign(store, self.config, wishes, clock, switch, crew) as campaign:
                return campaign.run()

    def release(self) -> None:
        with CampaignStore.open(self.path, read_only=False) as store:

            def journal(source: str, trigger: str, destination: str, reason: str) -> None:
                store.add_transition(source, destination, trigger, reason)

            CampaignMachine("held", journal).fire("release", "a person has looked")

    def records(self, cycle: int) -> int:
        with CampaignStore.open(self.path) as store, RunStore.open(store.run_path(cycle)) as run:
            return len(run.records())

    def reason(self) -> str:
        with CampaignStore.open(self.path) as store:
            last = store.last_transition()
        return "" if last is None else str(last.data["reason"])


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    (tmp_path / "telescope.toml").write_text(CONFIG)
    twin = build_twin(load_config(tmp_path / "telescope.toml"), SETTINGS, seed=4)
    text = CONFIG + DEVICES
    for facet_id, corners_px in twin.instrument.facet_polygons_px.items():
        text += f"[[reflector_map.polygons]]\nfacet_id = {facet_id}\ncorners_px = {corners_px.tolist()}\n"
    (tmp_path / "telescope.toml").write_text(text)
    site = Site(tmp_path, load_config(tmp_path / "telescope.toml"), twin)

    def open_driver(settings: CameraSettings, clock: MonotonicClock) -> Camera:
        return PluggedCamera(site.sockets[settings.role], settings, clock)

    monkeypatch.setattr(build_cameras, "open_driver", open_driver)
    return site


def test_a_campaign_by_hand_survives_a_kill_and_a_camera_that_is_lost_between_two_cycles(site: Site) -> None:
    unaligned = site.ratio_to_limit
    killed = Crew(site)
    killed.is_killed = True
    with pytest.raises(KeyboardInterrupt):
        site.run(killed)
    assert "a test" in site.reason()
    site.assert_all_is_let_go()
    n_records = site.records(1)
    site.release()

    # the first recording turns out to be complete; the second one needs the cameras that were opened for it
    crew = Crew(site)
    crew.pulls = "reflector"
    with pytest.raises(DeviceFaultError, match=r"reflector camera .*: there is no such camera") as caught:
        site.run(crew)
    assert "star camera" not in str(caught.value)
    assert str(caught.value) in site.reason()
    site.assert_all_is_let_go()  # the star camera, which was there, as well
    assert site.records(1) == n_records
    site.release()

    site.sockets["reflector"].is_there = True
    crew = Crew(site)
    assert site.run(crew) == "converged", site.reason()
    assert site.records(1) == n_records
    assert unaligned > 3.0 > ALIGNED > site.ratio_to_limit
    assert any("of 6 facets were turned as asked" in text for text in crew.told_texts)
    assert not [text for text in crew.told_texts if text.startswith("facet ")]  # nobody is accused of a slip
    site.assert_all_is_let_go()


def test_hardware_is_checked_and_let_go_before_a_campaign_begins(site: Site) -> None:
    told: list[str] = []
    assert check_hardware(site.config, told.append) == ["star camera (a test's, 0)", "reflector camera (a test's, 1)"]
    assert told[0].startswith("Trying whether the cameras make the exposures")
    assert [text.split(" camera ")[0] for text in told[1:]] == ["star", "reflector"]
    site.assert_all_is_let_go()
    site.sockets["reflector"].is_there = False
    with pytest.raises(DeviceFaultError, match=r"reflector camera .*: there is no such camera"):
        check_hardware(site.config, told.append)
    site.assert_all_is_let_go()
