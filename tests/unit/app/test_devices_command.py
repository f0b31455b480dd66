"""`namod-ctl devices`: what is listed, what matches the config, and what no driver can break."""

from __future__ import annotations

import json
import socket
import sys
import time
from pathlib import Path

import pytest
from drivers_that_misbehave import write_drivers
from typer.testing import CliRunner

import namod_ctl.app.commands.devices as command
from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.app.views.camera_listing import DriverListing, list_all_cameras
from namod_ctl.app.views.device_tables import Inventory, WantedDevice, answering_servers, as_json, wanted_devices
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.ports import FoundPort
from namod_ctl.devices.usb_tree import UsbDevice, UsbKind, UsbSpeed, UsbTree

STAR = FoundCamera("pylon", "Basler", "acA2500-14um", "21979447", "")
REFLECTOR = FoundCamera("pylon", "Basler", "acA1024-80uc", "21979448", "")
AS_GENICAM = FoundCamera("genicam", "Basler", "acA2500-14um", "21979447", "")
WEBCAM = FoundCamera("opencv", "Logitech", "C920", "", "/dev/video0")
SIMULATOR = FoundCamera("indi", "", "CCD Simulator", "", "127.0.0.1:7624")
PORT = FoundPort("/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_A50285BI", "FT232R USB UART", "A50285BI", (0x0403, 0x6001))


def usb_device(serial_number: str, kind: UsbKind = UsbKind.CAMERA) -> UsbDevice:
    return UsbDevice(kind, 0x2676, 0xBA02, "Basler", "ace", serial_number, 2, (1,), UsbSpeed.SUPER, True, False)


def inventory(*wanted: WantedDevice, usb: tuple[UsbDevice, ...] = (), answering: tuple = ()) -> Inventory:
    listings = [
        DriverListing("pylon", (STAR, REFLECTOR)),
        DriverListing("genicam", (AS_GENICAM,)),
        DriverListing("opencv", (WEBCAM,)),
        DriverListing("indi", (SIMULATOR,)),
        DriverListing("ueye", (), "uEye cameras need pyueye: install it with pip install 'namod-ctl[ueye]'"),
    ]
    return Inventory(listings, [PORT], UsbTree(usb, ("two cameras share one hub",)), wanted, answering)


def test_whatever_a_driver_does_the_others_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    started_s = time.monotonic()
    found = {listing.driver: listing for listing in list_all_cameras(write_drivers(tmp_path), patience_s=10.0)}
    assert time.monotonic() - started_s < 20.0
    assert found["good"].cameras == (FoundCamera("good", "ACME", "One", "17", ""),)
    assert found["good"].remark == ""
    assert found["none"] == found["stubborn"].__class__("none", ())
    assert found["stubborn"].remark == ""
    assert "pip install 'namod-ctl[acme]'" in found["missing"].remark
    assert "0xdead" in found["raising"].remark
    assert "crashed" in found["crashing"].remark
    assert "-11" in found["crashing"].remark
    assert "did not answer" in found["hanging"].remark
    assert "driver_that_is_not_there" in found["absent"].remark


@pytest.mark.parametrize(
    ("wanted", "cameras"),
    [
        (WantedDevice("star_camera", "pylon", "21979447", ""), [STAR]),
        (WantedDevice("star_camera", "", "21979447", ""), [STAR, AS_GENICAM]),  # no driver chosen yet
        (WantedDevice("star_camera", "pylon", "21979449", ""), []),
        (WantedDevice("star_camera", "pylon", "", ""), []),  # two of them: none is meant
        (WantedDevice("star_camera", "genicam", "", ""), [AS_GENICAM]),
        (WantedDevice("star_camera", "opencv", "", "0"), [WEBCAM]),
        (WantedDevice("star_camera", "opencv", "", "/dev/video1"), []),
        (WantedDevice("star_camera", "indi", "", "localhost"), [SIMULATOR]),
        (WantedDevice("star_camera", "indi", "", "localhost:7624", "CCD Simulator"), [SIMULATOR]),
        (WantedDevice("star_camera", "indi", "", "localhost:7624", "Guide Simulator"), []),
        (WantedDevice("star_camera", "indi", "", "localhost:7625"), []),
    ],
)
def test_which_camera_an_entry_means(wanted: WantedDevice, cameras: list[FoundCamera]) -> None:
    found = inventory(wanted)
    every = [camera for listing in found.listings for camera in listing.cameras]
    assert [camera for camera in every if found.entries_of_camera(camera) == ["star_camera"]] == cameras
    assert len(found.missing) == (not cameras)


def test_what_is_missing_is_said_with_what_to_do() -> None:
    on_usb = inventory(WantedDevice("star_camera", "ueye", "4002795734", ""), usb=(usb_device("4002795734"),))
    assert "though it is on the USB" in on_usb.missing[0]
    guid = WantedDevice("reflector_camera", "pylon", "21979448", "")
    assert inventory(guid, usb=(usb_device("2676014F6138"),)).entries_of_usb(usb_device("2676014F6138")) == [guid.entry]
    server = WantedDevice("star_camera", "alpaca", "", "10.0.0.7")
    assert "no server answers at 10.0.0.7:11111" in inventory(server).missing[0]
    assert inventory(server, answering=(("10.0.0.7", 11111),)).missing == []


def test_what_no_driver_lists_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    far = WantedDevice("star_camera", "indi", "", "10.0.0.7", "CCD Simulator")
    folder = WantedDevice("reflector_camera", "folder", "", str(tmp_path))
    told = inventory(far, folder, answering=(("10.0.0.7", 7624),)).unlisted
    assert ["its server answers" in told[0], "the folder is there" in told[1]] == [True, True]
    assert "namod-ctl camera snap reflector" in told[1]


def test_a_camera_that_its_server_does_not_have_is_missing() -> None:
    cameras = (FoundCamera("indi", "", "CCD Simulator", "", "127.0.0.1:7624"),)
    there = WantedDevice("star_camera", "indi", "", "localhost", "CCD Simulator")
    wrong = WantedDevice("reflector_camera", "indi", "", "localhost", "Guide Simulator")
    answering = {("localhost", 7624)}
    found = Inventory([DriverListing("indi", cameras)], [], UsbTree((), ()), (there, wrong), answering)
    assert len(found.missing) == 1
    assert "Guide Simulator" in found.missing[0]
    assert "its server has CCD Simulator; correct device" in found.missing[0]
    assert found.unlisted == []


def test_a_folder_is_there_or_not(tmp_path: Path) -> None:
    assert inventory(WantedDevice("star_camera", "folder", "", str(tmp_path))).missing == []
    assert "no such folder" in inventory(WantedDevice("star_camera", "folder", "", str(tmp_path / "x"))).missing[0]


def test_servers_are_asked() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        there = WantedDevice("star_camera", "indi", "", f"127.0.0.1:{port}")
        assert answering_servers([there]) == {("localhost", port)}
    assert answering_servers([there, WantedDevice("a", "pylon", "1", ""), WantedDevice("b", "indi", "", "//")]) == set()


def test_a_bus_is_found_by_any_name_of_its_port(tmp_path: Path) -> None:
    port = tmp_path / "ttyUSB7"
    port.touch()
    (tmp_path / "mirror").symlink_to(port)
    found = FoundPort(str(port), "", "", "", None)
    wanted = (
        WantedDevice("actuators.left", "serial", "", str(tmp_path / "mirror")),
        WantedDevice("actuators.right", "serial", "", str(tmp_path / "ttyUSB8")),
    )
    listed = Inventory([], [found], UsbTree((), ()), wanted)
    assert listed.entries_of_port(found) == ["actuators.left"]
    assert [text.split()[0] for text in listed.missing] == ["actuators.right"]


def test_the_entries_of_configs() -> None:
    assert wanted_devices(load_config("fact")) == []
    buses = [wanted for wanted in wanted_devices(load_config("fact_modbus_rtu")) if wanted.driver == "serial"]
    assert buses
    assert all(wanted.address.startswith("/dev/") for wanted in buses)


def config_with_cameras(folder: Path) -> Path:
    path = folder / "bench.toml"
    path.write_text(
        f'extends = "{builtin_folder() / "fact.toml"}"\n'
        '[star_camera]\nserial_number = "21979447"\n[star_camera.device]\ndriver = "pylon"\n'
        '[reflector_camera]\nserial_number = "4711"\n[reflector_camera.device]\ndriver = "ueye"\n'
    )
    return path


def test_the_command_in_json_and_for_people(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = inventory(usb=(usb_device("2676014F6137"),))
    monkeypatch.setattr(command, "list_all_cameras", lambda: known.listings)
    monkeypatch.setattr(command, "list_serial_ports", lambda: known.ports)
    monkeypatch.setattr(command, "read_usb_tree", lambda: known.usb)
    assert CliRunner().invoke(app, ["devices"]).exit_code == 0
    config = str(config_with_cameras(tmp_path))
    told = CliRunner().invoke(app, ["devices", "--config", config], env={"COLUMNS": "160"})
    assert told.exit_code == 1
    for text in ("acA2500-14um", "star_camera", "A50285BI", "pip install 'namod-ctl[ueye]'", "share one hub"):
        assert text in told.output
    assert "reflector_camera (ueye, serial number 4711) was not found" in told.output
    done = CliRunner().invoke(app, ["devices", "--config", config, "--json"])
    assert done.exit_code == 1
    data = json.loads(done.output)
    assert data["schema"] == "namod-devices/1"
    by_entry = {(c["driver"], c["serial_number"]): c["entries"] for c in data["cameras"]}
    assert by_entry[("pylon", "21979447")] == ["star_camera"]
    assert by_entry[("genicam", "21979447")] == []
    assert data["usb"][0]["entries"] == ["star_camera"]
    assert [text.split()[0] for text in data["missing"]] == ["reflector_camera"]
    assert {d["driver"] for d in data["drivers"] if d["remark"]} == {"ueye"}


def test_cameras_that_show_the_twins_sky_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    known = inventory()
    monkeypatch.setattr(command, "list_all_cameras", lambda: known.listings)
    monkeypatch.setattr(command, "list_serial_ports", lambda: known.ports)
    monkeypatch.setattr(command, "read_usb_tree", lambda: known.usb)
    told = CliRunner().invoke(app, ["devices", "--config", "bench_pylon"], env={"COLUMNS": "160"}).output
    for entry in ("star_camera", "reflector_camera"):
        assert f"{entry} (pylon): emulated, shown the twin's sky" in told
    assert "emulated" not in CliRunner().invoke(app, ["devices", "--config", "fact"]).output


def test_json_is_the_same_as_the_inventory() -> None:
    data = as_json(inventory(WantedDevice("star_camera", "opencv", "", "0")))
    assert json.loads(json.dumps(data)) == data
    assert [len(data[key]) for key in ("cameras", "serial_ports", "usb", "warnings", "missing")] == [5, 1, 0, 1, 0]
