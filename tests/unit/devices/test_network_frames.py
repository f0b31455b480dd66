"""Frames as camera servers send them, whole, damaged and made up: Alpaca's ImageBytes and JSON, INDI's FITS files."""

from __future__ import annotations

import io
import json
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.alpaca_camera import AlpacaCamera
from namod_ctl.devices.cameras.alpaca_http import (
    NETWORK_ERRORS,
    AlpacaDevice,
    AlpacaImageError,
    AlpacaRefusalError,
)
from namod_ctl.devices.cameras.alpaca_image import image_of_alpaca
from namod_ctl.devices.cameras.indi_image import frame_of_fits
from namod_ctl.devices.cameras.settings import CameraSettings

ELEMENT_TYPES = {1: "<i2", 2: "<i4", 3: "<f8", 4: "<f4", 6: "<u1", 8: "<u2", 9: "<u4"}
"""By their numbers in the table ImageArrayElementTypes of the Alpaca API reference."""
FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


class _Server(BaseHTTPRequestHandler):
    """Answers every request with `body`, or `bodies` in turn; `n_sent` bytes where they are fewer than announced."""

    protocol_version = "HTTP/1.1"
    body, n_sent, media_type = b"", 1 << 30, "application/imagebytes"
    bodies: ClassVar[list[bytes]] = []
    n_answers = 0

    def do_PUT(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.do_GET()

    def do_GET(self) -> None:
        if self.bodies:
            type(self).n_answers += 1
            type(self).body = self.bodies[self.n_answers % len(self.bodies)]
        self.send_response(200)
        self.send_header("Content-Type", self.media_type)
        self.send_header("Content-Length", str(len(self.body)))
        self.end_headers()
        with suppress(OSError):  # who asked has gone already
            self.wfile.write(self.body[: self.n_sent])
        self.close_connection = self.n_sent < len(self.body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with ThreadingHTTPServer(("127.0.0.1", 0), _Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def received(port: int, body: bytes, n_sent: int = 1 << 30, media_type: str = "application/imagebytes") -> NDArray[Any]:
    """What the driver makes of such an answer."""
    _Server.body, _Server.n_sent, _Server.media_type = body, n_sent, media_type
    device = AlpacaDevice("127.0.0.1", port, "camera", 0)
    try:
        return device.image()
    finally:
        device.close()


def image_bytes(planes: NDArray[Any], element_type: int, error: int = 0) -> bytes:
    """As the section AlpacaImageBytes of the API reference has it."""
    dimensions = (*planes.shape, 0)[:3]
    header = struct.pack("<11i", 1, error, 7, 8, 44, 2, element_type, planes.ndim, *dimensions)
    return header + planes.astype(ELEMENT_TYPES[element_type]).tobytes()


@st.composite
def sent_planes(draw: st.DrawFn) -> tuple[NDArray[Any], int]:
    """An image [x][y] or [x][y][colour], and the type it travels as."""
    shape = (*draw(st.tuples(st.integers(1, 7), st.integers(1, 7))), *draw(st.sampled_from([(), (3,)])))
    values = draw(st.lists(st.integers(0, 127), min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
    return np.array(values).reshape(shape), draw(st.sampled_from(sorted(ELEMENT_TYPES)))


@FEW
@given(sent=sent_planes())
def test_image_bytes_arrive_as_they_were_sent(port: int, sent: tuple[NDArray[Any], int]) -> None:
    planes, element_type = sent
    arrived = received(port, image_bytes(planes, element_type))
    assert arrived.dtype == np.dtype(ELEMENT_TYPES[element_type])
    assert np.array_equal(arrived, planes)


@FEW
@given(sent=sent_planes(), share=st.floats(0.0, 1.0, exclude_max=True))
def test_an_image_that_breaks_off_is_told(port: int, sent: tuple[NDArray[Any], int], share: float) -> None:
    body = image_bytes(*sent)
    with pytest.raises(AlpacaImageError, match="incomplete"):
        received(port, body, n_sent=int(share * len(body)))


@FEW
@given(
    body=st.one_of(st.binary(max_size=200), st.binary(max_size=60).map(lambda tail: struct.pack("<2i", 1, 0) + tail))
)
def test_any_answer_is_an_image_or_an_error(port: int, body: bytes) -> None:
    with suppress(AlpacaImageError, AlpacaRefusalError, *NETWORK_ERRORS):
        assert received(port, body).ndim in (2, 3)


@FEW
@given(
    answers=st.lists(
        st.one_of(
            st.none() | st.booleans() | st.integers(-1, 9) | st.floats() | st.text(max_size=3),
            st.lists(st.integers(), max_size=2),
        ),
        min_size=1,
        max_size=6,
    ),
    number=st.sampled_from([0, 0, 0, 0x400, 0x407, "many", None]),
)
def test_a_server_that_answers_anything_is_told(port: int, answers: list[object], number: object) -> None:
    """Wrong types, no values, errors where none can be: a message for a person, never a traceback."""
    _Server.n_sent, _Server.media_type = 1 << 30, "application/json"
    _Server.bodies = [json.dumps({"Value": value, "ErrorNumber": number}).encode() for value in (True, *answers)]
    settings = CameraSettings("star", "alpaca", 2, 2, 9.0, address=f"127.0.0.1:{port}", device="0")
    try:
        with suppress(ConfigError, DeviceFaultError):
            AlpacaCamera(settings, SystemMonotonicClock()).close()
    finally:
        _Server.bodies = []


def test_a_header_that_claims_too_much_takes_no_memory(port: int) -> None:
    header = struct.pack("<11i", 1, 0, 0, 0, 44, 2, 2, 3, 60_000, 60_000, 3)
    with pytest.raises(AlpacaImageError, match="announces 43200000000 bytes"):
        received(port, header + bytes(100))


def test_a_refusal_inside_of_an_image_is_one(port: int) -> None:
    body = struct.pack("<11i", 1, 0x40B, 0, 0, 44, 0, 0, 0, 0, 0, 0) + b"no image has been taken"
    with pytest.raises(AlpacaRefusalError, match="no image has been taken") as caught:
        received(port, body)
    assert caught.value.number == 0x40B


def test_images_of_older_servers_come_as_json(port: int) -> None:
    answer = {"Type": 2, "Rank": 2, "Value": [[1, 2], [3, 4], [5, 6]], "ErrorNumber": 0, "ErrorMessage": ""}
    arrived = received(port, json.dumps(answer).encode(), media_type="application/json; charset=utf-8")
    assert image_of_alpaca(arrived, 255.0, None).tolist() == [[1, 3, 5], [2, 4, 6]]
    ragged = {**answer, "Value": [[1, 2], [3]]}
    with pytest.raises(AlpacaImageError, match="different lengths"):
        received(port, json.dumps(ragged).encode(), media_type="application/json")


@pytest.mark.parametrize("dtype", ["<u1", "<u2", "<i2", "<i4", "<f8"])
@pytest.mark.parametrize("full_scale_adu", [255.0, 4095.0, 65535.0])
def test_alpacas_x_and_y_become_column_and_row(dtype: str, full_scale_adu: float) -> None:
    planes = np.zeros((4, 3), dtype)
    planes[3, 1] = 200  # the last column, the row in the middle
    image = image_of_alpaca(planes, full_scale_adu, None)
    assert image.shape == (3, 4)
    assert image.dtype == (np.uint8 if full_scale_adu == 255.0 else np.uint16)
    assert image[1, 3] == 200
    assert image.sum() == 200


def test_alpacas_red_green_blue_becomes_blue_green_red() -> None:
    planes = np.zeros((4, 2, 3), np.int32)
    planes[3, 1] = (10, 20, 30)
    assert image_of_alpaca(planes, 255.0, None)[1, 3].tolist() == [30, 20, 10]


@pytest.mark.parametrize("value", [-1, 4096])
def test_a_pixel_beyond_full_scale_is_told(value: int) -> None:
    with pytest.raises(AlpacaImageError, match="full_scale_adu = 4095"):
        image_of_alpaca(np.full((2, 2), value, np.int32), 4095.0, None)


def fits_file(pixels: NDArray[Any], **keywords: object) -> bytes:
    """Written by astropy, which knows FITS."""
    part = fits.PrimaryHDU(pixels)
    part.header.update({key.replace("_", "-"): value for key, value in keywords.items()})
    stream = io.BytesIO()
    part.writeto(stream)
    return stream.getvalue()


@pytest.mark.parametrize(("dtype", "full_scale_adu"), [(np.uint8, 255.0), (np.uint16, 65535.0), (np.uint16, 4095.0)])
def test_a_fits_file_gives_its_pixels_exposure_and_time(dtype: type, full_scale_adu: float) -> None:
    pixels = np.arange(12, dtype=dtype).reshape(3, 4) + dtype(full_scale_adu - 11)
    data = fits_file(pixels, EXPTIME=0.25, DATE_OBS="2026-11-22T21:04:05.678")
    frame = frame_of_fits(data, full_scale_adu, (0, 0), 1)
    assert np.array_equal(frame.image, pixels)
    assert frame.image.dtype == dtype
    assert frame.exposure_s == 0.25
    assert frame.begin is not None
    assert frame.begin.isoformat() == "2026-11-22T21:04:05.678000+00:00"


def test_a_fits_file_that_does_not_tell_is_used_nevertheless() -> None:
    frame = frame_of_fits(fits_file(np.ones((3, 4), np.uint8), DATE_OBS="yesterday"), 255.0, (0, 0), 1)
    assert frame.exposure_s is None
    assert frame.begin is None


def test_planes_of_colours_become_blue_green_red() -> None:
    planes = np.zeros((3, 2, 4), np.uint16)
    planes[:, 1, 3] = (10, 20, 30)
    assert frame_of_fits(fits_file(planes), 65535.0, (0, 0), 1).image[1, 3].tolist() == [30, 20, 10]


@pytest.mark.parametrize(
    ("pattern", "corner"), [("RGGB", (0, 0)), ("RGGB", (1, 0)), ("GBRG", (2, 3)), ("BGGR", (7, 5))]
)
def test_a_mosaic_in_a_fits_file_keeps_every_pixel(pattern: str, corner: tuple[int, int]) -> None:
    """The pattern is that of the sensor; a region that begins at an odd column begins with the neighbour's colour."""
    pixels = np.random.default_rng(1).integers(0, 65535, (8, 10), dtype=np.uint16)
    image = frame_of_fits(fits_file(pixels, BAYERPAT=pattern), 65535.0, corner, 1).image
    for row in range(1, 7):
        for column in range(1, 9):
            colour = pattern[2 * ((row + corner[1]) % 2) + (column + corner[0]) % 2]
            assert image[row, column, "BGR".index(colour)] == pixels[row, column]
    assert frame_of_fits(fits_file(pixels, BAYERPAT=pattern), 65535.0, corner, 2).image.ndim == 2


@FEW
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_a_fits_file_that_breaks_off_is_told(share: float) -> None:
    data = fits_file(np.full((120, 160), 9, np.uint16))[: 2880 + 120 * 160 * 2]  # without what only fills the block
    with pytest.raises(CommunicationError, match=r"FITS file|incomplete"):
        frame_of_fits(data[: int(share * len(data))], 65535.0, (0, 0), 1)


@FEW
@given(data=st.data())
@pytest.mark.filterwarnings("ignore")  # astropy's about what it mends
def test_a_damaged_fits_file_is_an_image_or_an_error(data: st.DataObject) -> None:
    sound = bytearray(fits_file(np.full((4, 5), 9, np.uint16), EXPTIME=0.25, DATE_OBS="2026-11-22T21:04:05.678"))
    for _ in range(data.draw(st.integers(1, 5))):
        sound[data.draw(st.integers(0, 900))] = data.draw(st.integers(0, 255))
    with suppress(CommunicationError):
        assert frame_of_fits(bytes(sound), 65535.0, (0, 0), 1).image.ndim in (2, 3)
