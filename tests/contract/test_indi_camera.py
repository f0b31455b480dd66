"""The INDI driver on the wire with INDI's own server and camera simulators."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from camera_contract import N_TRIES, CameraContract, CameraRig
from foreign_programs import ForeignServer, free_port
from indi_rig import (
    CAMERA,
    COLUMNS,
    LONGEST_S,
    OTHER_CAMERA,
    ROWS,
    SENSOR_COLUMNS,
    SENSOR_ROWS,
    SHORTEST_S,
    STAR_PX,
    WHOLE_PX,
    indi_server,
)
from numpy.typing import NDArray
from tcp_relay import Loss, TcpRelay

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.devices.cameras import indi_camera
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.indi_camera import IndiCamera, list_cameras
from namod_ctl.devices.cameras.settings import CameraSettings

CLOCK = SystemMonotonicClock()
FULL_SCALE_ADU = 65535.0
BACKGROUND_ADU = 4.5  # the simulator's noise: 0 to 9


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForeignServer]:
    server = indi_server(tmp_path_factory.mktemp("indi"))
    server.start()
    yield server
    server.kill()


@pytest.fixture
def settings(server: ForeignServer) -> CameraSettings:
    address = f"127.0.0.1:{server.port}"
    return CameraSettings("star", "indi", COLUMNS, ROWS, FULL_SCALE_ADU, address=address, device=CAMERA)


def take(settings: CameraSettings, *exposures_s: float) -> list[Exposure]:
    """One frame of each exposure, by a camera opened for that."""
    camera = IndiCamera(settings, CLOCK)
    try:
        frames = []
        for exposure_s in exposures_s:
            camera.start(exposure_s)
            frames.append(camera.fetch(5.0))
        return frames
    finally:
        camera.close()


def star_px(image: NDArray[np.unsignedinteger]) -> tuple[float, float]:
    """Centre of gravity (x, y) of what is well above the background."""
    light = np.clip(image.astype(float) - 10.0 * BACKGROUND_ADU, 0.0, None)
    y, x = np.indices(image.shape)
    return float((light * x).sum() / light.sum()), float((light * y).sum() / light.sum())


class TestIndiCamera(CameraContract):
    @pytest.fixture
    def rig(self, server: ForeignServer, settings: CameraSettings) -> Iterator[CameraRig]:
        relay = TcpRelay(server.port)
        settings = replace(settings, address=f"127.0.0.1:{relay.port}")
        rig = CameraRig(
            camera=IndiCamera(settings, CLOCK),
            clock=CLOCK,
            columns=COLUMNS,
            rows=ROWS,
            short_s=0.02,
            other_s=0.05,
            long_s=3.0,
            quantum_s=1e-4,
            timeout_s=3.0,
            mid_error_s=0.05,  # the order waits in the server until an earlier answer is acknowledged: 40 ms
            full_scale_adu=FULL_SCALE_ADU,
            reopen=lambda: IndiCamera(settings, CLOCK),
            lose_next_frame=lambda: relay.lose(Loss(b"<setBLOBVector", b"</setBLOBVector>")),
            take_away=relay.close,
        )
        yield rig
        rig.camera.close()
        relay.close()


def test_it_says_the_limits_of_the_device(settings: CameraSettings) -> None:
    camera = IndiCamera(settings, CLOCK)
    assert camera.exposure_range_s == (SHORTEST_S, LONGEST_S)
    assert CAMERA in camera.name
    camera.close()


def test_the_star_stands_where_the_simulator_draws_it(settings: CameraSettings) -> None:
    (exposure,) = take(settings, 0.05)
    assert star_px(exposure.image) == pytest.approx(STAR_PX, abs=WHOLE_PX)


def test_a_region_beside_the_middle_is_the_one_asked_for(settings: CameraSettings) -> None:
    """Moved by 30 to the right and 20 down from the middle, so the star moves the other way: neither is mirrored."""
    centred_x, centred_y = (SENSOR_COLUMNS - COLUMNS) // 2, (SENSOR_ROWS - ROWS) // 2
    (exposure,) = take(settings, 0.05)
    x_px, y_px = star_px(exposure.image)
    (exposure,) = take(replace(settings, offset_px=(centred_x + 30, centred_y + 20)), 0.05)
    assert star_px(exposure.image) == pytest.approx((x_px - 30, y_px - 20), abs=0.1)


def test_twice_the_exposure_is_twice_the_light(settings: CameraSettings) -> None:
    short, long = (float((frame.image - BACKGROUND_ADU).max()) for frame in take(settings, 0.03, 0.06))
    assert long / short == pytest.approx(2.0, rel=0.02)


def test_a_binned_frame_is_the_same_sky_in_larger_pixels(settings: CameraSettings) -> None:
    (exposure,) = take(replace(settings, columns=COLUMNS // 2, rows=ROWS // 2, binning=2), 0.02)
    assert exposure.image.shape == (ROWS // 2, COLUMNS // 2)
    assert star_px(exposure.image) == pytest.approx((STAR_PX[0] / 2.0, STAR_PX[1] / 2.0), abs=WHOLE_PX)


def test_the_exposure_began_when_the_server_says(server: ForeignServer, settings: CameraSettings) -> None:
    """The order arrives at once, the answer 0.3 s later: halfway between them would be wrong by 0.15 s."""
    relay = TcpRelay(server.port)
    camera = IndiCamera(replace(settings, address=f"127.0.0.1:{relay.port}"), CLOCK)
    relay.answer_delay_s = 0.3
    errors_s = []
    for _ in range(N_TRIES):
        before_s = CLOCK.monotonic_s()
        camera.start(0.05)
        errors_s.append(camera.fetch(5.0).mid_exposure_s - 0.025 - before_s)
    camera.close()
    relay.close()
    assert min(errors_s) >= 0.0
    assert min(errors_s) < 0.05


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"full_scale_adu": 70000.0}, "its pixels have 16 bit; set full_scale_adu = 65535"),
        ({"pixel_format": "Mono16"}, "pixel_format"),
        ({"binning": 5}, "CCD_BINNING HOR_BIN = 5, but it takes 1 to 4"),
        ({"columns": SENSOR_COLUMNS + 1}, "does not fit on its sensor of 1280 x 1024"),
        ({"offset_px": (-1, 0)}, "does not fit"),
        ({"gain": 1000.0}, "CCD_GAIN GAIN = 1000, but it takes 0 to 100"),
        ({"serial_number": "42"}, "INDI does not tell serial numbers"),
        ({"device": None}, f'several cameras: "{CAMERA}", "{OTHER_CAMERA}"'),
        ({"address": None}, "address is missing"),
        ({"address": "127.0.0.1:many"}, "write host:port"),
    ],
    ids=str,
)
def test_what_it_cannot_do_is_refused(settings: CameraSettings, change: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        IndiCamera(replace(settings, **change), CLOCK)


def test_the_gain_is_set(settings: CameraSettings, server: ForeignServer) -> None:
    camera = IndiCamera(replace(settings, gain=40.0), CLOCK)
    assert property_of(server, "CCD_GAIN.GAIN") == 40.0
    camera.close()
    camera = IndiCamera(settings, CLOCK)  # the lowest
    assert property_of(server, "CCD_GAIN.GAIN") == 0.0
    camera.close()


def property_of(server: ForeignServer, name: str) -> float:
    """What INDI's own client reads."""
    command = ["indi_getprop", "-p", str(server.port), "-1", f"{CAMERA}.{name}"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True, timeout=30).stdout)


def test_a_camera_that_is_not_there_is_told(settings: CameraSettings) -> None:
    with pytest.raises(DeviceFaultError, match=f'no device "ZWO 1"; it has "{CAMERA}", "{OTHER_CAMERA}"'):
        IndiCamera(replace(settings, device="ZWO 1"), CLOCK)


def test_no_server_is_told(settings: CameraSettings) -> None:
    with pytest.raises(DeviceFaultError, match=r"nothing answers there .*start indiserver"):
        IndiCamera(replace(settings, address=f"127.0.0.1:{free_port()}"), CLOCK)


def test_a_brighter_pixel_than_full_scale_is_told(settings: CameraSettings) -> None:
    camera = IndiCamera(replace(settings, full_scale_adu=4095.0), CLOCK)
    camera.start(0.1)
    with pytest.raises(CommunicationError, match=r"pixels of .* ADU came where full_scale_adu = 4095 is set"):
        camera.fetch(3.0)
    camera.close()


def test_no_thread_is_left_when_it_is_closed(settings: CameraSettings) -> None:
    take(settings, 0.02)
    deadline_s = time.monotonic() + 10.0
    while any(thread.name.startswith("indi ") for thread in threading.enumerate()) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("indi ")]


def test_cameras_of_the_server_on_this_computer_are_found(
    server: ForeignServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(indi_camera, "DEFAULT_PORT", server.port)
    address = f"127.0.0.1:{server.port}"
    assert list_cameras() == [FoundCamera("indi", "", name, "", address) for name in (CAMERA, OTHER_CAMERA)]
    monkeypatch.setattr(indi_camera, "DEFAULT_PORT", free_port())
    assert list_cameras() == []


def test_without_indipyclient_it_says_what_to_install(
    settings: CameraSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "indipyclient", None)
    with pytest.raises(ConfigError, match=r"pip install 'namod-ctl\[indi\]'"):
        IndiCamera(settings, CLOCK)
