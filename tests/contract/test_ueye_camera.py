"""The uEye driver behind the contract of all cameras: through the real pyueye, on a stand-in for IDS' shared library.

No camera was at hand, and IDS' library may not be passed on: `ueye_stand_in.c` does what the manual says it does. So
this shows that the driver and pyueye work together and that the driver keeps the contract, not what a camera does.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_contract import CameraContract, CameraRig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.devices.cameras.ueye_camera import WANTED_LONGEST_S, UeyeCamera, list_cameras

SOURCE = Path(__file__).with_name("ueye_stand_in.c")
GREY, COLOUR = "4002795719", "4102602113"  # serial numbers of the stand-in's cameras
COLUMNS, ROWS = 636, 480  # rows of 636 x 3 bytes are not padded, those of 637 would be
CLOCK = SystemMonotonicClock()


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The stand-in's own functions; pyueye finds it as IDS' library."""
    if shutil.which("gcc") is None:
        pytest.skip("no C compiler for the stand-in of IDS' library: apt-get install gcc libc6-dev")
    folder = tmp_path_factory.mktemp("ueye")
    path = folder / "libueye_api.so"
    subprocess.run(["gcc", "-Wall", "-Wextra", "-O1", "-shared", "-fPIC", "-o", path, SOURCE], check=True)
    os.environ["PYUEYE_DLL_PATH"] = str(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportWarning)  # the stand-in has only those functions that are used
        pytest.importorskip("pyueye", reason="pyueye is not installed: pip install 'namod-ctl[ueye]'")
        importlib.import_module("pyueye.ueye")
    return ctypes.CDLL(str(path))


@pytest.fixture(autouse=True)
def stand_in(library: ctypes.CDLL) -> ctypes.CDLL:
    """All cameras plugged in, and closed."""
    library.stand_in_reset()
    return library


def settings(**changed: Any) -> CameraSettings:
    usual: dict[str, Any] = {
        "role": "star",
        "driver": "ueye",
        "columns": COLUMNS,
        "rows": ROWS,
        "full_scale_adu": 255.0,
    }
    return CameraSettings(**(usual | {"serial_number": GREY} | changed))


@contextmanager
def opened(**changed: Any) -> Iterator[UeyeCamera]:
    camera = UeyeCamera(settings(**changed), CLOCK)
    try:
        yield camera
    finally:
        camera.close()


class _UeyeContract(CameraContract):
    asked: dict[str, Any]  # beyond the usual settings
    is_colour = False

    @pytest.fixture
    def rig(self, stand_in: ctypes.CDLL) -> Iterator[CameraRig]:
        def open_camera() -> UeyeCamera:
            return UeyeCamera(settings(**self.asked), CLOCK)

        number = int(self.is_colour)
        camera = open_camera()
        rig = CameraRig(
            camera=camera,
            clock=CLOCK,
            columns=self.asked.get("columns", COLUMNS),
            rows=ROWS,
            full_scale_adu=self.asked.get("full_scale_adu", 255.0),
            is_colour=self.is_colour,
            short_s=0.02,
            other_s=0.05,
            long_s=3.0,
            quantum_s=5.1e-5,
            timeout_s=0.5,
            mid_error_s=0.02,
            reopen=open_camera,
            lose_next_frame=lambda: stand_in.stand_in_lose_next(number),
            take_away=lambda: stand_in.stand_in_take_away(number),
        )
        yield rig
        camera.close()
        rig.camera.close()


class TestGrey10Bit(_UeyeContract):
    asked = {"full_scale_adu": 1023.0}  # noqa: RUF012 - it is not changed


class TestColourInPaddedRows(_UeyeContract):
    asked = {"serial_number": COLOUR, "columns": 637}  # noqa: RUF012
    is_colour = True


@pytest.mark.parametrize(
    ("changed", "n_channels"),
    [({}, 0), ({"full_scale_adu": 1023.0}, 0), ({"serial_number": COLOUR}, 3), ({"columns": 637}, 0)],
)
def test_pixels_are_those_of_the_last_trigger(changed: dict[str, Any], n_channels: int) -> None:
    """The stand-in paints x + 2 y + number of the trigger, and the channel's number."""
    n_values = int(changed.get("full_scale_adu", 255.0)) + 1
    ramp = np.arange(changed.get("columns", COLUMNS))[None, :] + 2 * np.arange(ROWS)[:, None]
    if n_channels:
        ramp = ramp[..., None] + np.arange(n_channels)
    with opened(**changed) as camera:
        for number in (1, 2, 3):
            camera.start(0.001)
            assert np.array_equal(camera.fetch(0.5).image, (ramp + number) % n_values)


def test_exposures_of_three_seconds_are_possible_at_the_fastest_clock_that_allows_them(stand_in: ctypes.CDLL) -> None:
    with opened() as camera:
        assert camera.exposure_range_s[1] >= WANTED_LONGEST_S
        assert stand_in.stand_in_clock_mhz(0) == 10  # 40 and 20 MHz end at 1 and 2 s, 5 MHz would read out slower


def test_automatics_are_off_and_the_region_is_in_the_middle(stand_in: ctypes.CDLL) -> None:
    assert stand_in.stand_in_automatics(0) == 0
    with opened():
        assert stand_in.stand_in_automatics(0) == 0
        assert abs(stand_in.stand_in_x(0) - (1280 - COLUMNS) / 2) <= 4
    with opened(binning=2, columns=320, rows=240):
        assert stand_in.stand_in_x(0) == (640 - 320) / 2
    with opened(offset_px=(8, 4)):
        assert stand_in.stand_in_x(0) == 8


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"columns": 5000}, ["5000", "1280 x 960", "columns"]),
        ({"offset_px": (3, 0)}, ["(3, 0", "offset_px"]),
        ({"binning": 4}, ["binning = 4", "change binning"]),
        ({"binning": 7}, ["binning = 7", "1, 2, 3, 4"]),
        ({"gain": 101.0}, ["gain = 101", "0 to 100"]),
        ({"full_scale_adu": 4095.0}, ["Mono12", "pixel_format"]),
        ({"pixel_format": "Mono10"}, ["Mono10", "1023", "full_scale_adu"]),
        ({"pixel_format": "YUV422_8"}, ["YUV422_8", "Mono8, Mono10"]),
        ({"serial_number": None}, [GREY, COLOUR, "serial_number"]),
        ({"address": "192.0.2.7"}, ["serial_number", "address"]),
    ],
)
def test_what_the_camera_does_not_take_is_refused(changed: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught, opened(**changed):
        pass
    assert all(word in str(caught.value) for word in ["star camera", *words]), caught.value
    with opened():  # the refused one was let go
        pass


def test_a_gain_that_is_silently_ignored_is_refused_with_both_values(stand_in: ctypes.CDLL) -> None:
    stand_in.stand_in_refuse_gain(0)
    with pytest.raises(ConfigError, match=r"gain = 10\.0 was asked for, the camera keeps 50"), opened(gain=10.0):
        pass


def test_a_camera_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(DeviceFaultError) as caught, opened(serial_number="4711"):
        pass
    assert all(number in str(caught.value) for number in ("4711", GREY, COLOUR))


def test_a_camera_that_another_program_uses_says_so() -> None:
    with opened(), pytest.raises(DeviceFaultError, match="other programs"), opened():
        pass


def test_cameras_are_listed(stand_in: ctypes.CDLL) -> None:
    assert list_cameras() == [
        FoundCamera("ueye", "IDS", "UI148xSE-M", GREY, ""),
        FoundCamera("ueye", "IDS", "DCU223C", COLOUR, ""),
    ]
    stand_in.stand_in_take_away(0)
    assert [camera.serial_number for camera in list_cameras()] == [COLOUR]


def test_a_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyueye.ueye", None)
    with pytest.raises(ConfigError, match=r"pip install 'namod-ctl\[ueye\]'.*IDS"):
        list_cameras()
