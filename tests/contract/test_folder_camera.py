"""The camera behind a folder: the contract of all cameras, with a program at the other end that is none of ours, and
what may go wrong with files."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from camera_contract import CameraContract, CameraRig
from frame_program import FrameProgram, bytes_of, write_fits, write_png, write_tiff

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.folder_camera import FolderCamera, list_cameras
from namod_ctl.devices.cameras.settings import CameraSettings

COLUMNS, ROWS = 40, 30
EXPOSURES_S = (0.001, 10.0)
SETTINGS = CameraSettings("star", "folder", COLUMNS, ROWS, 255.0, exposure_range_s=EXPOSURES_S)
CLOCK = SystemMonotonicClock()
GREY = np.random.default_rng(3).integers(0, 256, (ROWS, COLUMNS), dtype=np.uint8)
COLOUR = np.random.default_rng(4).integers(0, 256, (ROWS, COLUMNS, 3), dtype=np.uint8)
DEEP = np.random.default_rng(5).integers(0, 4096, (ROWS, COLUMNS), dtype=np.uint16)

KINDS = {
    "FITS, 12 bit, finishes all": (DEEP, 4095.0, write_fits, True),
    "PNG, colour, finishes all": (COLOUR, 255.0, write_png, True),
    "TIFF, 12 bit, says no request": (DEEP, 4095.0, write_tiff, False),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    return folder


def camera_of(folder: Path, **changes: object) -> FolderCamera:
    return FolderCamera(replace(SETTINGS, address=str(folder), **changes), CLOCK)


@pytest.mark.parametrize("kind", KINDS)
class TestFolderCamera(CameraContract):
    @pytest.fixture
    def rig(self, folder: Path, kind: str) -> Iterator[CameraRig]:
        pixels, full_scale_adu, write, is_stubborn = KINDS[kind]

        def reopen() -> FolderCamera:
            return camera_of(folder, full_scale_adu=full_scale_adu)

        with FrameProgram(folder, pixels, write, is_stubborn=is_stubborn) as program:

            def take_away() -> None:
                folder.rename(folder.with_name("elsewhere"))

            rig = CameraRig(
                camera=reopen(),
                clock=CLOCK,
                columns=COLUMNS,
                rows=ROWS,
                full_scale_adu=full_scale_adu,
                is_colour=pixels.ndim == 3,
                short_s=0.02,
                other_s=0.08,
                long_s=3.0,
                quantum_s=1e-9,
                timeout_s=1.5,
                mid_error_s=0.1,
                reopen=reopen,
                lose_next_frame=lambda: setattr(program, "n_to_lose", 1),
                take_away=take_away,
            )
            yield rig
            rig.camera.close()

    def test_the_pixels_are_those_that_were_written(self, rig: CameraRig, kind: str) -> None:
        assert np.array_equal(rig.take().image, KINDS[kind][0])


def drop(folder: Path, name: str, exposure_s: float = 0.01, pixels: np.ndarray = GREY, **cards: object) -> None:
    """A frame as FITS, written aside and renamed."""
    data = io.BytesIO()
    fits.PrimaryHDU(pixels, fits.Header({"EXPOSURE": exposure_s, **cards})).writeto(data)
    (folder / f".{name}").write_bytes(data.getvalue())
    (folder / f".{name}").rename(folder / name)


def fetched_later(camera: FolderCamera, timeout_s: float = 5.0) -> tuple[ThreadPoolExecutor, object]:
    worker = ThreadPoolExecutor(1)
    return worker, worker.submit(camera.fetch, timeout_s)


def test_frames_that_were_there_are_never_delivered(folder: Path) -> None:
    for number in range(5):
        drop(folder, f"old_{number}.fits")
    camera = camera_of(folder)
    camera.start(0.01)
    with pytest.raises(CommunicationError, match="nothing new came"):
        camera.fetch(0.2)


def test_a_frame_whose_name_is_used_again_is_new(folder: Path) -> None:
    drop(folder, "latest.fits")
    camera = camera_of(folder)
    for _ in range(2):
        camera.start(0.01)
        worker, done = fetched_later(camera)
        CLOCK.wait_s(0.05)  # the exposure
        drop(folder, "latest.fits", 0.01, GREY[::-1].copy())
        assert np.array_equal(done.result(10.0).image, GREY[::-1])
        worker.shutdown()


def test_of_a_program_that_exposes_as_it_pleases_only_frames_begun_after_the_start_count(folder: Path) -> None:
    camera = camera_of(folder)
    is_over = threading.Event()

    def expose_on_and_on() -> None:
        number = 0
        while not is_over.is_set():
            began_s = CLOCK.monotonic_s()
            CLOCK.wait_s(0.06)
            number += 1
            drop(folder, f"free_{number:05d}.fit", 0.06, np.full_like(GREY, number), BEGAN=began_s)

    with ThreadPoolExecutor(1) as worker:
        worker.submit(expose_on_and_on)
        try:
            for phase_s in (0.0, 0.017, 0.034, 0.051):
                CLOCK.wait_s(phase_s)
                camera.start(0.06)
                started_s = CLOCK.monotonic_s()
                exposure = camera.fetch(3.0)
                number = int(exposure.image[0, 0])
                began_s = float(fits.getheader(folder / f"free_{number:05d}.fit")["BEGAN"])
                assert exposure.exposure_s == 0.06
                assert began_s > started_s - 0.04  # what the way through the file system takes
                assert exposure.mid_exposure_s == pytest.approx(began_s + 0.03, abs=0.05)
        finally:
            is_over.set()


@pytest.mark.parametrize("ending", [".fits", ".png", ".tif"])
def test_a_file_that_is_half_written_is_waited_for(folder: Path, ending: str) -> None:
    whole = bytes_of(GREY, ending)
    camera = camera_of(folder)
    camera.start(0.01)
    (folder / "frame.txt").write_text("exposure_s = 0.01\n")
    with (folder / f"frame{ending}").open("wb") as file:
        file.write(whole[: len(whole) * 2 // 3])
        file.flush()
        worker, done = fetched_later(camera)
        CLOCK.wait_s(0.3)
        assert not done.done()
        file.write(whole[len(whole) * 2 // 3 :])
    assert np.array_equal(done.result(10.0).image, GREY)
    worker.shutdown()


def test_a_file_that_has_its_size_before_its_pixels_is_waited_for(folder: Path) -> None:
    """As programs do that map a file into their memory: it looks whole from the first moment on."""
    whole = bytes_of(GREY, ".fits")
    camera = camera_of(folder)
    camera.start(0.01)
    worker, done = fetched_later(camera)
    with (folder / "frame.fits").open("wb") as file:
        file.write(whole[:2880])
        file.truncate(len(whole))
        for begin in range(2880, 2880 + GREY.size, 50):
            file.seek(begin)
            file.write(whole[begin : begin + 50])
            file.flush()
            CLOCK.wait_s(0.008)
    assert np.array_equal(done.result(10.0).image, GREY)
    worker.shutdown()


def test_what_was_missing_is_told_when_time_is_over(folder: Path) -> None:
    camera = camera_of(folder)
    camera.start(0.01)
    (folder / "frame.png").write_bytes(bytes_of(GREY, ".png"))
    with pytest.raises(CommunicationError, match=r"frame\.json or frame\.txt"):
        camera.fetch(0.2)
    camera.start(0.01)
    (folder / "cut.fits").write_bytes(bytes_of(GREY, ".fits")[:3000])
    with pytest.raises(CommunicationError, match=r"cut\.fits: 3000 bytes of 4080"):
        camera.fetch(0.2)


@pytest.mark.parametrize(
    ("changes", "pixels", "says"),
    [
        ({}, GREY[:-1], r"40 x 29 pixels, the config wants 40 x 30"),
        ({}, DEEP, r"16 bit, full_scale_adu = 255"),
        ({"full_scale_adu": 4095.0}, GREY, r"8 bit, full_scale_adu = 4095"),
        ({"full_scale_adu": 1023.0}, DEEP, r"more than full_scale_adu = 1023"),
    ],
)
def test_a_frame_that_does_not_fit_the_config_says_what_to_mend(
    folder: Path, changes: dict[str, object], pixels: np.ndarray, says: str
) -> None:
    camera = camera_of(folder, **changes)
    camera.start(0.01)
    worker, done = fetched_later(camera)
    CLOCK.wait_s(0.05)
    drop(folder, "frame.fits", 0.01, pixels)
    with pytest.raises(CommunicationError, match=says):
        done.result(10.0)
    worker.shutdown()


def test_a_mosaic_becomes_colour(folder: Path) -> None:
    camera = camera_of(folder, pixel_format="BayerRG8")
    mosaic = np.zeros((ROWS, COLUMNS), dtype=np.uint8)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = 200, 20  # red and blue
    mosaic[::2, 1::2] = mosaic[1::2, ::2] = 90
    camera.start(0.01)
    worker, done = fetched_later(camera)
    CLOCK.wait_s(0.05)
    drop(folder, "frame.fits", 0.01, mosaic)
    image = done.result(10.0).image
    assert np.array_equal(image[1:-1, 1:-1], np.broadcast_to(np.uint8([20, 90, 200]), (ROWS - 2, COLUMNS - 2, 3)))
    worker.shutdown()


def test_the_time_in_the_header_is_taken_before_the_time_of_arrival(folder: Path) -> None:
    camera = camera_of(folder)
    camera.start(0.05)
    started_s = CLOCK.monotonic_s()
    worker, done = fetched_later(camera)
    CLOCK.wait_s(0.02)
    began, began_s = datetime.now(UTC), CLOCK.monotonic_s()
    CLOCK.wait_s(0.3)  # an exposure of 0.05 s, and a slow download
    drop(folder, "frame.fits", 0.05, **{"DATE-OBS": began.strftime("%Y-%m-%dT%H:%M:%S.%f")})
    exposure = done.result(10.0)
    worker.shutdown()
    assert exposure.mid_exposure_s == pytest.approx(began_s + 0.025, abs=0.01)
    assert exposure.mid_exposure_s > started_s


@pytest.mark.parametrize(("by_s", "says"), [(-60.0, "before it was asked for"), (60.0, "exposed after it came")])
def test_a_clock_that_is_wrong_is_told(folder: Path, by_s: float, says: str) -> None:
    camera = camera_of(folder)
    camera.start(0.01)
    request = json.loads((folder / "request.json").read_text())["request"]
    began = datetime.now(UTC) + timedelta(seconds=by_s)
    cards = {"DATE-OBS": began.strftime("%Y-%m-%dT%H:%M:%S.%f"), "NAMODREQ": request}
    drop(folder, "frame.fits", 0.01, **cards)
    with pytest.raises(CommunicationError, match=f"{says}.*clocks of both computers"):
        camera.fetch(0.2)


def test_the_request_can_be_read_and_goes_when_nothing_is_wanted(folder: Path) -> None:
    camera = camera_of(folder)
    assert not (folder / "request.json").exists()
    camera.start(0.25)
    first = json.loads((folder / "request.json").read_text())
    assert first["schema"] == "namod-exposure-request/1"
    assert first["role"] == "star"
    assert first["exposure_s"] == 0.25
    camera.start(0.5)
    second = json.loads((folder / "request.json").read_text())
    assert second["exposure_s"] == 0.5
    assert second["request"] != first["request"]
    camera.close()
    assert list(folder.iterdir()) == []


def test_the_folder_must_be_there_when_it_is_opened(folder: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        camera_of(folder / "elsewhere")
    with pytest.raises(ConfigError, match="no such folder"):
        FolderCamera(SETTINGS, CLOCK)


def test_the_range_of_exposures_is_told_by_the_config_or_the_manifest(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"exposure_range_s.*camera\.json"):
        camera_of(folder, exposure_range_s=None)
    manifest = folder / "camera.json"
    manifest.write_text('{"exposure_range_s": [0.5, 20], "model": "QHY5III", "serial_number": "77"}')
    camera = camera_of(folder, exposure_range_s=None)
    assert camera.exposure_range_s == (0.5, 20.0)
    assert "QHY5III" in camera.name
    assert camera_of(folder).exposure_range_s == EXPOSURES_S
    assert camera_of(folder, serial_number="77").exposure_range_s == EXPOSURES_S
    with pytest.raises(ConfigError, match="serial number 77, the config wants 78"):
        camera_of(folder, serial_number="78")
    for broken in ("{", "[]", '{"exposure_range_s": [1, 0.5]}', '{"exposure_range_s": ["a", "b"]}'):
        manifest.write_text(broken)
        with pytest.raises(ConfigError, match=r"camera\.json"):
            camera_of(folder, exposure_range_s=None)


def test_a_folder_that_cannot_be_written_is_a_fault(folder: Path) -> None:
    camera = camera_of(folder)
    (folder / "request.json" / "in_the_way").mkdir(parents=True)
    with pytest.raises(DeviceFaultError, match=r"request\.json cannot be written"):
        camera.start(0.01)


def test_no_folder_is_found_by_itself() -> None:
    assert list_cameras() == []
