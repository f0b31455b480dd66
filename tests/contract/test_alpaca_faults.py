"""The Alpaca driver when its server dies, hangs, is restarted, or used by somebody else; alone and in a recording."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from alpaca_rig import ARCSEC_PER_PX, BIAS_ADU, CATALOGUE, COLUMNS, ROWS, STAR_OFFSET_PX, alpaca_server
from camera_contract import STOPPED_S
from foreign_programs import ForeignServer
from killed_server import N_WANTED, assert_nothing_lost, record_through_a_kill

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.cameras.alpaca_camera import AlpacaCamera
from namod_ctl.devices.cameras.settings import CameraSettings

ROLES = ("star", "reflector", "faint")
FULL_SCALE_ADU = 65535.0
SEEING_PX = 1.0 / ARCSEC_PER_PX  # full width at half maximum


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("alpaca")


@pytest.fixture(scope="module")
def any_server(folder: Path) -> Iterator[ForeignServer]:
    faint = {"gain": 40, "fullwellcapacity": 40 * 65535}  # electrons per ADU
    server = alpaca_server(folder, cameras=({}, {}, faint), drift_arcsec_per_s=0.1)
    yield server
    server.kill()


@pytest.fixture
def server(any_server: ForeignServer) -> ForeignServer:
    if not any_server.is_running:
        any_server.start()
    return any_server


@pytest.fixture
def open_camera(server: ForeignServer) -> Callable[[str], AlpacaCamera]:
    def open_camera(role: str) -> AlpacaCamera:
        number = str(ROLES.index(role))
        address = f"127.0.0.1:{server.port}"
        settings = CameraSettings(role, "alpaca", COLUMNS, ROWS, FULL_SCALE_ADU, address=address, device=number)
        return AlpacaCamera(settings, SystemMonotonicClock())

    return open_camera


@pytest.fixture
def camera(open_camera: Callable[[str], AlpacaCamera]) -> Iterator[AlpacaCamera]:
    camera = open_camera("star")
    yield camera
    camera.close()


def test_a_recording_goes_on_when_the_server_was_killed_and_started_again(
    tmp_path: Path, server: ForeignServer, open_camera: Callable[[str], AlpacaCamera]
) -> None:
    done = record_through_a_kill(tmp_path / "RUN", server, open_camera, SEEING_PX, FULL_SCALE_ADU, comes_back=True)
    assert done.reason == "all records wanted are there"
    assert done.star.n_recoveries == 1
    assert done.reflector.n_recoveries == 1
    assert_nothing_lost(done)
    assert len(done.accepted) >= N_WANTED
    for record in done.accepted:  # the telescope moves north only: east of where it points the star stays
        x, _ = done.star_model.pixel_of_theta(record.theta_rad)
        assert x == pytest.approx((COLUMNS - 1) / 2.0 - STAR_OFFSET_PX[0], abs=0.7)


def test_a_recording_holds_while_the_server_is_away_and_can_be_stopped(
    tmp_path: Path, server: ForeignServer, open_camera: Callable[[str], AlpacaCamera]
) -> None:
    done = record_through_a_kill(tmp_path / "RUN", server, open_camera, SEEING_PX, FULL_SCALE_ADU, comes_back=False)
    assert done.reason == "stopped by hand"
    assert f"Alpaca server 127.0.0.1:{server.port}" in done.troubles[0]
    assert "to bring it back" in done.troubles[0]
    assert_nothing_lost(done)


def test_a_server_that_was_restarted_between_two_exposures_is_found_out(
    server: ForeignServer, camera: AlpacaCamera
) -> None:
    camera.start(0.02)
    camera.fetch(5.0)
    server.kill()
    server.start()  # with the settings that it begins with
    with pytest.raises(DeviceFaultError, match="restarted: its NumX is 320 where 160 was set"):
        camera.start(0.02)
    with pytest.raises(DeviceFaultError, match="restarted"):
        camera.fetch(5.0)


def test_another_program_that_changes_the_frame_is_found_out(server: ForeignServer, camera: AlpacaCamera) -> None:
    alpaca_camera = pytest.importorskip("alpaca.camera", reason="alpyca is not installed (pip install alpyca)")
    peer = alpaca_camera.Camera(f"127.0.0.1:{server.port}", 0)
    peer.NumX = 100
    peer.rqs.close()
    camera.start(0.02)
    with pytest.raises(DeviceFaultError, match="a frame of 100 x 120 pixels came, not one of 160 x 120"):
        camera.fetch(5.0)


def test_an_exposure_that_failed_is_told_and_the_next_one_comes(folder: Path, camera: AlpacaCamera) -> None:
    """Without its catalogue of stars the simulator makes no frame, and says so by its state."""
    (folder / CATALOGUE).rename(folder / "elsewhere")
    camera.start(0.02)
    with pytest.raises(CommunicationError, match="the exposure failed"):
        camera.fetch(5.0)
    (folder / "elsewhere").replace(folder / CATALOGUE)
    camera.start(0.02)
    assert camera.fetch(5.0).image.max() > 10_000  # the star


def test_a_frame_that_was_given_up_does_not_come_as_the_next_one(open_camera: Callable[[str], AlpacaCamera]) -> None:
    """The simulator finishes an exposure although it was aborted, and shows its frame as if it were the new one.

    How bright the star is tells which frame it is.
    """
    camera = open_camera("faint")
    camera.start(0.5)
    adu_per_s = (int(camera.fetch(5.0).image.max()) - BIAS_ADU) / 0.5
    for left_s in (0.3, 0.4):
        camera.start(1.4)
        time.sleep(1.4 - left_s)
        for exposure_s in (0.02, left_s + 0.5):  # the second ends well after that which was given up
            camera.start(exposure_s)
            light_adu = int(camera.fetch(5.0).image.max()) - BIAS_ADU
            assert light_adu == pytest.approx(adu_per_s * exposure_s, rel=0.2)  # 1.4 s would be 50 % more, or 70 times
    camera.close()


def test_it_closes_while_the_server_hangs(server: ForeignServer, camera: AlpacaCamera) -> None:
    camera.start(0.02)
    server.pause()
    caught: list[BaseException] = []

    def fetch() -> None:
        with pytest.raises(CommunicationError, match="closed") as error:
            camera.fetch(5.0)
        caught.append(error.value)

    fetching = threading.Thread(target=fetch)
    fetching.start()
    time.sleep(0.2)  # now it waits for an answer
    began_s = time.monotonic()
    camera.close()
    fetching.join(10.0)
    assert time.monotonic() - began_s < STOPPED_S
    assert caught
    server.resume()
