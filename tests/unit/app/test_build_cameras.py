"""From a config's device tables to cameras: what is refused at check, what when the cameras are opened."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from namod_ctl.app.build.cameras import CAMERA_CLASSES, camera_settings, has_cameras, open_cameras
from namod_ctl.app.build.sky_session import open_sky_session
from namod_ctl.app.config.camera_schema import KEYS_OF_DRIVER
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError, DeviceFaultError
from namod_ctl.store.run import RunStore

CLOCK = SystemMonotonicClock()
FOLDERS = """
[star_camera.device]
driver = "folder"
address = "star_frames"
exposure_range_s = [0.001, 3.0]

[reflector_camera.device]
driver = "folder"
address = "reflector_frames"
exposure_range_s = [0.001, 5.0]
"""

Write = Callable[[str], InstrumentConfig]


@pytest.fixture
def read(tmp_path: Path) -> Write:
    """Reads FACT's config with these device tables."""

    def read(tables: str) -> InstrumentConfig:
        path = tmp_path / "observatory.toml"
        path.write_text('extends = "fact"\n' + tables)
        return load_config(path)

    return read


def test_every_key_of_the_table_reaches_the_driver(read: Write) -> None:
    config = read(
        '[star_camera]\nserial_number = "21838345"\n[star_camera.device]\ndriver = "pylon"\npixel_format = "Mono8"\n'
        "gain = 3\noffset_px = [8, 4]\nbinning = 2\n"
        '[reflector_camera.device]\ndriver = "indi"\naddress = "obs:7624"\ndevice = "CCD Simulator"\n'
    )
    star = camera_settings(config, "star")
    assert (star.role, star.driver, star.columns, star.rows) == ("star", "pylon", 2560, 1920)
    assert (star.serial_number, star.pixel_format, star.gain) == ("21838345", "Mono8", 3.0)
    assert (star.offset_px, star.binning, star.full_scale_adu) == ((8, 4), 2, 255.0)
    reflector = camera_settings(config, "reflector")
    assert (reflector.driver, reflector.address, reflector.device) == ("indi", "obs:7624", "CCD Simulator")
    assert (reflector.columns, reflector.rows, reflector.binning, reflector.gain) == (1024, 768, 1, None)
    assert has_cameras(config)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('driver = "gphoto"', r"star_camera\.device\.driver.*'pylon', 'genicam', 'ueye'"),
        ('driver = "ueye"\naddress = "10.0.0.7"', r"address is no key of driver = \"ueye\", which knows pixel_format"),
        ('driver = "opencv"\nbinning = 2', r"binning is no key of driver = \"opencv\""),
        ('driver = "folder"', r"driver = \"folder\" needs the key address"),
        ('driver = "alpaca"', r"driver = \"alpaca\" needs the key address"),
        ('driver = "opencv"\nexposure_range_s = [1.0, 0.1]', "shortest and the longest exposure in s, in this order"),
        ('driver = "opencv"\nexposure_range_ms = [1.0, 10.0]', r"is in ms.*expected in s: convert.*exposure_range_s"),
        ('driver = "pylon"\npixel_fromat = "Mono8"', r"unknown key.*did you mean pixel_format"),
        ('driver = "pylon"\npixel_format = "Mono9"', r"star_camera\.device\.pixel_format: .*Mono8/10/12/16"),
        ('driver = "pylon"\nbinning = 0', r"star_camera\.device\.binning = 0 is not plausible"),
        ('driver = "genicam"\noffset_px = [1]', r"star_camera\.device\.offset_px"),
        ("gain = 1.0", r"star_camera\.device\.driver: this key is missing"),
    ],
)
def test_a_table_with_a_mistake_is_refused_with_its_place(read: Write, table: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        read(f"[star_camera.device]\n{table}\n")


@pytest.mark.parametrize("driver", sorted(KEYS_OF_DRIVER))
def test_every_driver_refuses_every_key_that_is_none_of_it(read: Write, driver: str) -> None:
    values = {
        "address": '"x:1"',
        "device": '"x"',
        "pixel_format": '"Mono8"',
        "gain": "1.0",
        "offset_px": "[0, 0]",
        "binning": "1",
        "exposure_range_s": "[0.1, 1.0]",
        "fed_by_twin": "true",
    }
    assert driver in CAMERA_CLASSES
    for key in set(values) - set(KEYS_OF_DRIVER[driver]):
        with pytest.raises(ConfigError, match=rf"{key} is no key of driver = \"{driver}\""):
            read(f'[star_camera.device]\ndriver = "{driver}"\n{key} = {values[key]}\n')
    own = "".join(f"{key} = {values[key]}\n" for key in KEYS_OF_DRIVER[driver])
    assert read(f'[star_camera.device]\ndriver = "{driver}"\n{own}').star_camera.device is not None


def test_a_depth_beyond_the_format_is_refused(read: Write) -> None:
    with pytest.raises(ConfigError, match=r"Mono8 ends at 255, but star_camera\.full_scale_adu = 4095"):
        read('[star_camera]\nfull_scale_adu = 4095\n[star_camera.device]\ndriver = "pylon"\npixel_format = "Mono8"\n')


def test_one_device_for_both_cameras_is_refused(read: Write) -> None:
    both = '[star_camera.device]\ndriver = "pylon"\n[reflector_camera.device]\ndriver = "pylon"\n'
    with pytest.raises(ConfigError, match=r"nothing tells them apart.*serial_number"):
        read(both)
    assert has_cameras(read(both + '[star_camera]\nserial_number = "1"\n[reflector_camera]\nserial_number = "2"\n'))


def test_one_device_alone_is_half_a_telescope(read: Write) -> None:
    with pytest.raises(ConfigError, match=r"reflector_camera\.device.*--twin"):
        has_cameras(read('[star_camera.device]\ndriver = "pylon"\n'))
    assert not has_cameras(read(""))


def test_a_stored_config_has_the_same_devices(read: Write, tmp_path: Path) -> None:
    config = read(FOLDERS)
    assert camera_settings(config, "star").address == str(tmp_path / "star_frames")  # written beside the config
    assert InstrumentConfig.from_json(config.to_json(), "run") == config


def test_both_cameras_are_opened_or_none(read: Write, tmp_path: Path) -> None:
    config = read(FOLDERS)  # the folders are missing, which is no matter until the cameras are opened
    with pytest.raises(ConfigError, match=r"(?s)star_frames: there is no such folder.*reflector_frames: there is no"):
        open_cameras(config, CLOCK)
    (tmp_path / "star_frames").mkdir()
    with pytest.raises(ConfigError, match="reflector_frames: there is no such folder") as caught:
        open_cameras(config, CLOCK)
    assert "star_frames" not in str(caught.value)
    (tmp_path / "reflector_frames").mkdir()
    star, reflector = open_cameras(config, CLOCK)
    assert "star" in star.name
    assert reflector.exposure_range_s == (0.001, 5.0)
    star.start(0.1)
    reflector.start(0.1)
    for camera, folder in ((star, "star_frames"), (reflector, "reflector_frames")):
        assert (tmp_path / folder / "request.json").exists()
        camera.close()
        assert not (tmp_path / folder / "request.json").exists()


def test_the_first_camera_is_closed_when_the_second_fails(
    read: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from namod_ctl.devices.cameras import folder_camera

    (tmp_path / "star_frames").mkdir()
    closed = []
    close = folder_camera.FolderCamera.close
    monkeypatch.setattr(
        folder_camera.FolderCamera, "close", lambda camera: (closed.append(camera.name), close(camera))[1]
    )
    with pytest.raises(ConfigError):
        open_cameras(read(FOLDERS), CLOCK)
    assert len(closed) == 1
    assert "star_frames" in closed[0]


def test_a_session_is_begun_only_with_cameras_that_are_there(read: Write, tmp_path: Path) -> None:
    read(FOLDERS)
    config, out = str(tmp_path / "observatory.toml"), tmp_path / "run"
    with ExitStack() as stack:
        with pytest.raises(ConfigError, match="no such folder"):
            open_sky_session(stack, out, None, config, force=False)
        assert not out.exists()
        for name in ("star_frames", "reflector_frames"):
            (tmp_path / name).mkdir()
        session = open_sky_session(stack, out, None, config, force=False)
        assert session is not None
        assert "star_frames" in session.store.source
        assert len(session.store.facet_ids) == 30
    with ExitStack() as stack:
        resumed = open_sky_session(stack, None, out, config, force=False)
        assert resumed is not None
        assert resumed.config == session.config
    with ExitStack() as stack, pytest.raises(DeviceFaultError, match="closed"):
        resumed.equipment.star_camera.start(0.1)
    with ExitStack() as stack, pytest.raises(ConfigError, match="another config"):
        open_sky_session(stack, None, out, "fact", force=False)
    with RunStore.open(out) as store:
        assert store.records() == []


def test_without_devices_there_is_no_session_under_the_sky(read: Write, tmp_path: Path) -> None:
    with ExitStack() as stack:
        assert open_sky_session(stack, tmp_path / "run", None, "fact", force=False) is None
    assert not (tmp_path / "run").exists()


def test_drivers_are_loaded_without_the_libraries_of_makers() -> None:
    """Whoever has one maker's camera needs the library of none of the others."""
    look = """
import importlib, sys
from namod_ctl.app.build.cameras import CAMERA_CLASSES
for driver, name in CAMERA_CLASSES.items():
    module = importlib.import_module(f"namod_ctl.devices.cameras.{driver}_camera")
    assert callable(getattr(module, name)) and callable(module.list_cameras), driver
print(sorted({"pypylon", "pyueye", "alpaca", "indipyclient", "gi"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
