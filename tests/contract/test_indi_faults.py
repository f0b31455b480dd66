"""The INDI driver when server or camera driver die, hang, or obey somebody else; alone and in a recording."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from camera_contract import STOPPED_S
from indi_rig import CAMERA, COLUMNS, OTHER_CAMERA, ROWS, STAR_PX, WHOLE_PX, IndiServer, indi_server
from killed_server import N_WANTED, assert_nothing_lost, record_through_a_kill

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.cameras.indi_camera import IndiCamera
from namod_ctl.devices.cameras.settings import CameraSettings

FULL_SCALE_ADU = 65000.0  # where the simulator saturates
STAR_FWHM_PX = 3.2  # measured in its frames


@pytest.fixture
def server(tmp_path: Path) -> Iterator[IndiServer]:
    server = indi_server(tmp_path)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def open_camera(server: IndiServer) -> Callable[[str], IndiCamera]:
    def open_camera(role: str) -> IndiCamera:
        device = CAMERA if role == "star" else OTHER_CAMERA
        address = f"127.0.0.1:{server.port}"
        settings = CameraSettings(role, "indi", COLUMNS, ROWS, FULL_SCALE_ADU, address=address, device=device)
        return IndiCamera(settings, SystemMonotonicClock())

    return open_camera


@pytest.fixture
def camera(open_camera: Callable[[str], IndiCamera]) -> Iterator[IndiCamera]:
    camera = open_camera("star")
    yield camera
    camera.close()


def tell(server: IndiServer, order: str) -> None:
    """Another program, INDI's own, sets a property of the camera."""
    command = ["indi_setprop", "-p", str(server.port), f"{CAMERA}.{order}"]
    subprocess.run(command, check=True, timeout=30)


def test_a_recording_goes_on_when_the_server_was_killed_and_started_again(
    tmp_path: Path, server: IndiServer, open_camera: Callable[[str], IndiCamera]
) -> None:
    done = record_through_a_kill(tmp_path / "RUN", server, open_camera, STAR_FWHM_PX, FULL_SCALE_ADU, comes_back=True)
    assert done.reason == "all records wanted are there"
    assert done.star.n_recoveries == 1
    assert done.reflector.n_recoveries == 1
    assert_nothing_lost(done)
    assert len(done.accepted) >= N_WANTED
    for record in done.accepted:
        assert done.star_model.pixel_of_theta(record.theta_rad) == pytest.approx(STAR_PX, abs=WHOLE_PX)


def test_a_recording_holds_while_the_server_is_away_and_can_be_stopped(
    tmp_path: Path, server: IndiServer, open_camera: Callable[[str], IndiCamera]
) -> None:
    done = record_through_a_kill(tmp_path / "RUN", server, open_camera, STAR_FWHM_PX, FULL_SCALE_ADU, comes_back=False)
    assert done.reason == "stopped by hand"
    assert f"INDI server 127.0.0.1:{server.port}" in done.troubles[0]
    assert "to bring it back" in done.troubles[0]
    assert_nothing_lost(done)


def test_a_driver_that_crashed_is_told_and_can_be_opened_again(
    server: IndiServer, camera: IndiCamera, open_camera: Callable[[str], IndiCamera]
) -> None:
    """The server starts it again, but its camera is not connected then and has forgotten what was set."""
    camera.start(3.0)
    tell(server, "CCD_SIMULATE_CRASH.CRASH=On")
    began_s = time.monotonic()
    with pytest.raises(DeviceFaultError, match="its driver was restarted"):
        camera.fetch(2.0)
    assert time.monotonic() - began_s < 2.0  # it is not waited for until its exposure is over
    with pytest.raises(DeviceFaultError, match="its driver was restarted"):
        camera.start(0.05)
    camera.close()
    camera = open_camera("star")
    camera.start(0.05)
    assert camera.fetch(3.0).image.shape == (ROWS, COLUMNS)
    camera.close()


def test_another_program_that_only_looks_does_no_harm(server: IndiServer, camera: IndiCamera) -> None:
    """The server then tells all its clients of all properties anew."""
    subprocess.run(["indi_getprop", "-p", str(server.port), "-t", "1"], check=False, timeout=30, capture_output=True)
    camera.start(0.3)
    subprocess.run(["indi_getprop", "-p", str(server.port), "-t", "1"], check=False, timeout=30, capture_output=True)
    assert camera.fetch(3.0).exposure_s == pytest.approx(0.3)


def test_another_program_that_disconnects_the_camera_is_told(server: IndiServer, camera: IndiCamera) -> None:
    camera.start(3.0)
    tell(server, "CONNECTION.DISCONNECT=On")
    with pytest.raises(DeviceFaultError, match="another program disconnected it"):
        camera.fetch(2.0)


def test_another_program_that_aborts_the_exposure_is_told_and_the_next_one_comes(
    server: IndiServer, camera: IndiCamera
) -> None:
    camera.start(3.0)
    tell(server, "CCD_ABORT_EXPOSURE.ABORT=On")
    with pytest.raises(CommunicationError, match="the exposure failed"):
        camera.fetch(2.0)
    camera.start(0.05)
    assert camera.fetch(3.0).exposure_s == pytest.approx(0.05)


def test_another_program_that_changes_the_frame_is_found_out(server: IndiServer, camera: IndiCamera) -> None:
    tell(server, "CCD_FRAME.X;Y;WIDTH;HEIGHT=0;0;100;120")
    camera.start(0.05)
    with pytest.raises(DeviceFaultError, match="a frame of 100 x 120 pixels came, not one of 160 x 120"):
        camera.fetch(3.0)
    with pytest.raises(DeviceFaultError, match="a frame of 100 x 120 pixels"):
        camera.start(0.05)


def test_a_server_that_hangs_is_waited_for_and_its_late_frame_is_not_the_next_one(
    server: IndiServer, camera: IndiCamera
) -> None:
    server.pause()
    camera.start(0.03)
    with pytest.raises(CommunicationError, match=r"no frame within 0\.3 s"):
        camera.fetch(0.3)
    camera.start(0.06)
    server.resume()
    exposure = camera.fetch(3.0)
    assert exposure.exposure_s == pytest.approx(0.06)
    assert exposure.frame_id == 2


def test_it_closes_while_the_server_hangs(server: IndiServer, camera: IndiCamera) -> None:
    camera.start(3.0)
    server.pause()
    began_s = time.monotonic()
    camera.close()
    assert time.monotonic() - began_s < STOPPED_S
    server.resume()
