"""The Alpaca driver on the wire with a camera simulator that others wrote, and with alpyca, the client others wrote."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest
from alpaca_rig import (
    BIAS_ADU,
    COLUMNS,
    LONGEST_S,
    ROWS,
    SENSOR_COLUMNS,
    SENSOR_ROWS,
    SHORTEST_S,
    STAR_OFFSET_PX,
    alpaca_server,
)
from camera_contract import CameraContract, CameraRig
from foreign_programs import ForeignServer, free_port
from numpy.typing import NDArray
from tcp_relay import Loss, TcpRelay

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.devices.cameras.alpaca_camera import AlpacaCamera, list_cameras
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.settings import CameraSettings

CLOCK = SystemMonotonicClock()
PLAIN, WITH_GAINS, BAYER, UNSTOPPABLE = range(4)
CAMERAS: tuple[dict[str, Any], ...] = (
    {},
    {"gains": ["low", "high"]},
    {"sensortype": 2, "bayeroffsetx": 1, "bayeroffsety": 0},
    {"canabortexposure": False},
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForeignServer]:
    server = alpaca_server(tmp_path_factory.mktemp("alpaca"), CAMERAS)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def settings(server: ForeignServer) -> CameraSettings:
    return CameraSettings(
        "star", "alpaca", COLUMNS, ROWS, full_scale_adu=65535.0, address=f"127.0.0.1:{server.port}", device="0"
    )


def take(settings: CameraSettings, *exposures_s: float) -> list[Exposure]:
    """One frame of each exposure, by a camera opened for that."""
    camera = AlpacaCamera(settings, CLOCK)
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
    light = np.clip(image.astype(float) - 2.0 * BIAS_ADU, 0.0, None)
    y, x = np.indices(image.shape)
    return float((light * x).sum() / light.sum()), float((light * y).sum() / light.sum())


class TestAlpacaCamera(CameraContract):
    @pytest.fixture
    def rig(self, server: ForeignServer, settings: CameraSettings) -> Iterator[CameraRig]:
        relay = TcpRelay(server.port)
        settings = replace(settings, address=f"127.0.0.1:{relay.port}")
        rig = CameraRig(
            camera=AlpacaCamera(settings, CLOCK),
            clock=CLOCK,
            columns=COLUMNS,
            rows=ROWS,
            short_s=0.02,
            other_s=0.05,
            long_s=3.0,
            quantum_s=1e-4,
            timeout_s=5.0,
            mid_error_s=0.03,  # half of what the order takes on a busy computer
            full_scale_adu=65535.0,
            reopen=lambda: AlpacaCamera(settings, CLOCK),
            lose_next_frame=lambda: relay.lose(Loss(b"application/imagebytes", n_kept=1000)),
            take_away=relay.close,
        )
        yield rig
        rig.camera.close()
        relay.close()


def test_it_says_the_limits_of_the_device(settings: CameraSettings) -> None:
    camera = AlpacaCamera(settings, CLOCK)
    assert camera.exposure_range_s == (SHORTEST_S, LONGEST_S)
    assert "Simulator Camera" in camera.name
    camera.close()


def test_the_star_stands_where_the_simulated_sky_has_it(settings: CameraSettings) -> None:
    """North is up and east is left in the simulator: a frame that is turned or mirrored shows the star elsewhere."""
    (exposure,) = take(settings, 0.02)
    east_px, north_px = STAR_OFFSET_PX
    # where it points is in a corner of the four middle pixels, or between them: 0.5 px
    assert star_px(exposure.image) == pytest.approx(((COLUMNS - 1) / 2 - east_px, (ROWS - 1) / 2 - north_px), abs=0.7)


def test_eight_times_the_exposure_is_eight_times_the_light(settings: CameraSettings) -> None:
    short, long = (float(frame.image.max()) - BIAS_ADU for frame in take(settings, 0.004, 0.032))
    assert long / short == pytest.approx(
        8.0, rel=0.35
    )  # its star twinkles: 5 % from frame to frame, more in short ones


def test_a_binned_frame_is_the_same_sky_in_larger_pixels(settings: CameraSettings) -> None:
    (exposure,) = take(replace(settings, columns=COLUMNS // 2, rows=ROWS // 2, binning=2), 0.005)
    assert exposure.image.shape == (ROWS // 2, COLUMNS // 2)
    east_px, north_px = (offset / 2.0 for offset in STAR_OFFSET_PX)
    middle = ((COLUMNS / 2 - 1) / 2 - east_px, (ROWS / 2 - 1) / 2 - north_px)
    assert star_px(exposure.image) == pytest.approx(middle, abs=0.7)


def test_alpyca_reads_the_same_pixels(settings: CameraSettings, server: ForeignServer) -> None:
    alpaca_camera = pytest.importorskip("alpaca.camera", reason="alpyca is not installed (pip install alpyca)")
    camera = AlpacaCamera(settings, CLOCK)
    camera.start(0.03)
    image = camera.fetch(5.0).image
    peer = alpaca_camera.Camera(f"127.0.0.1:{server.port}", 0)
    pixels, info = peer.ImageArray, peer.ImageArrayInfo
    assert np.array_equal(np.array(pixels).reshape(info.Dimension1, info.Dimension2).T, image)
    region = (peer.StartX, peer.StartY, peer.NumX, peer.NumY)
    assert region == ((SENSOR_COLUMNS - COLUMNS) // 2, (SENSOR_ROWS - ROWS) // 2, COLUMNS, ROWS)
    peer.rqs.close()
    camera.close()


def test_a_mosaic_becomes_colours_and_keeps_every_pixel(settings: CameraSettings, server: ForeignServer) -> None:
    """Its first pixel is green, the next red, those below blue and green (BayerOffsetX is 1): values that were
    measured stay, in the channel of their colour."""
    alpaca_camera = pytest.importorskip("alpaca.camera", reason="alpyca is not installed (pip install alpyca)")
    (exposure,) = take(replace(settings, device=str(BAYER)), 0.03)
    peer = alpaca_camera.Camera(f"127.0.0.1:{server.port}", BAYER)
    raw = np.array(peer.ImageArray).reshape(COLUMNS, ROWS).T
    peer.rqs.close()
    blue, green, red = range(3)
    assert exposure.image.shape == (ROWS, COLUMNS, 3)
    for colour, first_row, first_column in ((green, 2, 2), (green, 3, 3), (red, 2, 3), (blue, 3, 2)):
        here = np.s_[first_row:-2:2, first_column:-2:2]
        assert np.array_equal(exposure.image[(*here, colour)], raw[here])


def test_a_gain_that_is_not_taken_is_found_out(settings: CameraSettings) -> None:
    """The simulator counts its gains from 0 when one is set and from 1 when it is read: so it is not what was set."""
    with pytest.raises(ConfigError, match="Gain = 0 was set, but it stays at 1"):
        AlpacaCamera(replace(settings, device=str(WITH_GAINS)), CLOCK)


def test_an_exposure_that_cannot_be_stopped_is_told_and_over_at_its_end(settings: CameraSettings) -> None:
    camera = AlpacaCamera(replace(settings, device=str(UNSTOPPABLE)), CLOCK)
    camera.start(0.3)
    with pytest.raises(DeviceFaultError, match="cannot be stopped"):
        camera.start(0.02)
    for _ in range(100):
        try:
            camera.start(0.02)
        except DeviceFaultError:  # it is about to show the frame of the one before
            CLOCK.wait_s(0.1)
        else:
            break
    assert camera.fetch(5.0).exposure_s == pytest.approx(0.02)
    camera.close()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"full_scale_adu": 4095.0}, "full_scale_adu = 4095, but its MaxADU is 65535"),
        ({"pixel_format": "Mono16"}, "pixel_format"),
        ({"binning": 9}, "it bins at most 8"),
        ({"columns": SENSOR_COLUMNS + 1}, "does not fit on its sensor of 320 x 240"),
        ({"offset_px": (SENSOR_COLUMNS - COLUMNS + 1, 0)}, "does not fit"),
        ({"gain": 3.0}, "gain cannot be set"),
        ({"gain": 0.5}, "whole numbers"),
        ({"device": "first"}, 'device = "first" is no device number'),
        ({"device": None}, 'no list of its devices .* device = "0"'),
        ({"device": str(BAYER), "binning": 2, "columns": 80, "rows": 60}, "mixes the colours"),
        ({"address": None}, "address is missing"),
        ({"address": "http://127.0.0.1"}, "names no server"),
        ({"address": "127.0.0.1:many"}, "write host:port"),
    ],
    ids=str,
)
def test_what_it_cannot_do_is_refused(settings: CameraSettings, change: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        AlpacaCamera(replace(settings, **change), CLOCK)


@pytest.mark.parametrize("device", ["7", "99"])
def test_a_camera_that_is_not_there_is_told(settings: CameraSettings, device: str) -> None:
    with pytest.raises(DeviceFaultError, match="not found"):
        AlpacaCamera(replace(settings, device=device), CLOCK)


def test_no_server_is_told(settings: CameraSettings) -> None:
    with pytest.raises(DeviceFaultError, match="nothing answers there; start the server"):
        AlpacaCamera(replace(settings, address=f"127.0.0.1:{free_port()}"), CLOCK)


class _TwoCameras(BaseHTTPRequestHandler):
    """The list of devices of a server, as the example of the Alpaca API's reference has it."""

    def do_GET(self) -> None:
        devices = [
            {"DeviceName": "Super focuser 1", "DeviceType": "Focuser", "DeviceNumber": 0, "UniqueID": "a"},
            {"DeviceName": "Super camera 1", "DeviceType": "Camera", "DeviceNumber": 0, "UniqueID": "277C652F"},
            {"DeviceName": "Super camera 2", "DeviceType": "Camera", "DeviceNumber": 1, "UniqueID": "55E7A2A1"},
        ]
        body = json.dumps({"Value": devices, "ClientTransactionID": 0, "ServerTransactionID": 1}).encode()
        self.send_response(200 if "configureddevices" in self.path else 400)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def list_server() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), _TwoCameras) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{server.server_port}"
        server.shutdown()


def test_several_cameras_are_listed_and_not_guessed(list_server: str) -> None:
    settings = CameraSettings("star", "alpaca", COLUMNS, ROWS, 65535.0, address=list_server)
    with pytest.raises(ConfigError, match=r"number 0: Super camera 1 .*277C652F.*, number 1: Super camera 2"):
        AlpacaCamera(settings, CLOCK)
    with pytest.raises(DeviceFaultError, match="no such camera; it has number 0: Super camera 1"):
        AlpacaCamera(replace(settings, serial_number="other"), CLOCK)


def test_cameras_of_servers_in_the_network_are_found(list_server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """alpyca finds the servers; here it is told one, as its broadcasts would reach whoever is in this network."""
    discovery = pytest.importorskip("alpaca.discovery", reason="alpyca is not installed (pip install alpyca)")
    nobody = f"127.0.0.1:{free_port()}"
    monkeypatch.setattr(discovery, "search_ipv4", lambda **_: [nobody, list_server])
    assert list_cameras() == [
        FoundCamera("alpaca", "", "Super camera 1", "277C652F", list_server),
        FoundCamera("alpaca", "", "Super camera 2", "55E7A2A1", list_server),
    ]


def test_looking_for_servers_without_alpyca_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "alpaca.discovery", None)
    with pytest.raises(ConfigError, match=r"pip install 'namod-ctl\[alpaca\]'"):
        list_cameras()
