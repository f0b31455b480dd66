"""The USB tree and resets, on real pyusb code over a bus in memory."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
import usb.core
from virtual_usb import (
    BOS_SUPER_SPEED,
    BOS_WEBUSB,
    FULL,
    HID,
    HIGH,
    U3V,
    UVC,
    VENDOR,
    VirtualDevice,
    VirtualUsb,
    basler,
    ftdi,
)

from namod_ctl.devices.usb_reset import CameraReset
from namod_ctl.devices.usb_tree import (
    CAMERA_MAKERS,
    SERIAL_CHIPS,
    UsbKind,
    is_serial_number,
    read_usb_tree,
    udev_rule,
    usb_warnings,
)

USB_IDS = Path("/usr/share/misc/usb.ids")


def tree_of(*devices: VirtualDevice) -> tuple[list[str], tuple[str, ...]]:
    tree = read_usb_tree(VirtualUsb(list(devices)))
    return [device.path for device in tree.devices], tree.warnings


def test_devices_say_what_they_are_and_where() -> None:
    hub = VirtualDevice(0x05E3, 0x0626, ("Genesys", "Hub", ""), (4,), device_class=9)
    mouse = VirtualDevice(0x046D, 0xC077, ("Logitech", "Mouse", ""), (2,), bus=1, classes=(HID,), speed=FULL)
    webcam = VirtualDevice(0x046D, 0x0825, ("", "HD Webcam", "1AB2"), (4, 2), 1, HIGH, 0x0200, (UVC,))
    wheel = VirtualDevice(0x03C3, 0x1F01, ("ZWO", "EFW", ""), (5,), bus=1, classes=(HID,), speed=FULL)
    tree = read_usb_tree(VirtualUsb([hub, mouse, basler(), webcam, ftdi(), wheel]))
    assert [(d.kind, d.path, d.hub, d.vendor, d.product, d.serial_number) for d in tree.devices] == [
        (UsbKind.SERIAL, "1-3", "", "FTDI", "FT232R USB UART", "A50285BI"),
        (UsbKind.CAMERA, "1-4.2", "1-4", "", "HD Webcam", "1AB2"),
        (UsbKind.CAMERA, "2-1", "", "Basler", "acA2500-14um", "2676014F6137"),
    ]
    assert [str(device.speed) for device in tree.devices] == [
        "USB 1, 12 Mbit/s",
        "USB 2, 480 Mbit/s",
        "USB 3, 5 Gbit/s",
    ]
    assert tree.warnings == ()


def test_no_device_stays_open() -> None:
    devices = [basler(), ftdi(), basler(5, ports=(2,), bus=1, speed=HIGH, version=0x0210, bos=BOS_SUPER_SPEED)]
    read_usb_tree(VirtualUsb(list(devices)))
    assert [device.opened for device in devices] == [0, 0, 0]


@pytest.mark.parametrize(
    ("classes", "version", "bos", "is_warned"),
    [
        ((U3V,), 0x0210, b"", True),  # USB3 Vision by its class, whatever else it says
        ((VENDOR,), 0x0210, BOS_SUPER_SPEED, True),
        ((VENDOR,), 0x0210, BOS_WEBUSB, False),
        ((VENDOR,), 0x0200, b"", False),  # a real USB 2 camera
        ((VENDOR,), 0x0210, b"", False),  # it does not say: no claim
    ],
)
def test_a_usb_3_camera_at_usb_2_speed_is_told(
    classes: tuple[tuple[int, int], ...], version: int, bos: bytes, is_warned: bool
) -> None:
    camera = VirtualDevice(0x1E10, 0x3300, ("PGR", "BFS", "1"), (2,), 1, HIGH, version, classes, bos)
    _, warnings = tree_of(camera)
    assert [("USB 2, 480 Mbit/s" in text and "1-2" in text) for text in warnings] == [True] * is_warned
    assert list(usb_warnings(read_usb_tree(VirtualUsb([basler()])).devices)) == []


@pytest.mark.parametrize(
    ("places", "what"),
    [
        (((1, 2), (1, 3)), "share the hub 2-1"),
        (((1, 2), (1, 4, 1)), "share the hub 2-1"),  # one of them behind a second hub
        (((1, 4, 1), (1, 4, 2)), "share the hub 2-1.4"),  # the last hub is where they can be parted
        (((1,), (2,)), ""),
        (((1, 2), (3, 2)), ""),
    ],
)
def test_two_cameras_on_one_hub_are_told(places: tuple[tuple[int, ...], ...], what: str) -> None:
    _, warnings = tree_of(*(basler(100 + n, ports=ports) for n, ports in enumerate(places)))
    assert len(warnings) == bool(what)
    assert all(what in text and "share the hub" in text for text in warnings)


def test_two_usb_2_cameras_on_one_controller_are_told_once() -> None:
    old = {"bus": 1, "speed": HIGH, "version": 0x0200, "classes": (VENDOR,)}
    _, warnings = tree_of(basler(1, ports=(1,), **old), basler(2, ports=(2,), **old))
    assert ["controller of bus 1" in text for text in warnings] == [True]
    _, warnings = tree_of(basler(1, ports=(1, 1), **old), basler(2, ports=(1, 2), **old))
    assert ["hub 1-1" in text for text in warnings] == [True]
    _, warnings = tree_of(basler(1, ports=(1,), **old), basler(2, ports=(1,), **old | {"bus": 3}))
    assert warnings == ()


def test_a_camera_without_permission_gives_the_rule_to_install() -> None:
    _, warnings = tree_of(basler(is_forbidden=True))
    assert len(warnings) == 1
    assert 'ATTR{idVendor}=="2676", ATTR{idProduct}=="ba02"' in warnings[0]
    assert "udevadm control --reload-rules" in warnings[0]
    assert udev_rule(0x1409).count("==") == 2  # every uEye, whatever its product id becomes after it has booted


def test_a_hung_device_and_a_missing_libusb_do_not_break_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    paths, _ = tree_of(basler(is_hung=True), ftdi())
    assert paths == ["1-3", "2-1"]

    def find(**_: object) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    tree = read_usb_tree()
    assert tree.devices == ()
    assert "apt install libusb" in tree.warnings[0]


@pytest.mark.parametrize(
    ("on_usb", "in_config", "is_same"),
    [
        ("2676014F61B7", "21979575", True),  # 0x014F61B7
        ("2676014F61B7", "2676014f61b7", True),
        ("2676014F61B7", "21979576", False),
        ("4002795734", "4002795734", True),
        ("0000012345", "12345", True),
        ("", "12345", False),
        ("12345", "", False),
        ("000000000000", "0", False),
    ],
)
def test_serial_numbers_of_makers_and_of_the_usb(on_usb: str, in_config: str, is_same: bool) -> None:
    assert is_serial_number(on_usb, in_config) == is_same


def test_makers_are_those_of_the_usb_ids() -> None:
    """The list of linux-usb.org, which Debian's package usb.ids installs."""
    if not USB_IDS.exists():
        pytest.skip("usb.ids is not installed: apt install usb.ids")
    makers: dict[int, str] = {}
    vendor_id = 0
    products: set[tuple[int, int]] = set()
    for line in USB_IDS.read_text(errors="replace").splitlines():
        if line.startswith("# List of known device classes"):
            break
        if line[:1] == "\t" and line[1:2] not in ("\t", ""):
            products.add((vendor_id, int(line[1:5], 16)))
        elif line and line[0] not in "#\t":
            vendor_id = int(line[:4], 16)
            makers[vendor_id] = line[6:]
    ours = CAMERA_MAKERS | {vendor_id: name for vendor_id, (name, _) in SERIAL_CHIPS.items()}
    listed = {vendor_id: name for vendor_id, name in ours.items() if vendor_id in makers}
    assert ours.keys() - listed.keys() == {0x1618, 0x20E7}  # which it does not list
    for vendor_id, name in listed.items():
        known = "Future Technology Devices" if name == "FTDI" else name.split()[0]
        assert known.lower() in makers[vendor_id].lower()
    for ids in ((0x0403, 0x6001), (0x10C4, 0xEA60), (0x1A86, 0x7523), (0x067B, 0x2303)):
        assert ids in products
        assert ids[1] in SERIAL_CHIPS[ids[0]][1]


def test_a_reset_befalls_the_camera_of_the_serial_number_only() -> None:
    star, reflector, adapter = basler(1, ports=(1,)), basler(2, ports=(2,)), ftdi()
    bus = VirtualUsb([star, reflector, adapter])
    assert CameraReset("2", backend=bus)().is_done
    assert [device.n_resets for device in (star, reflector, adapter)] == [0, 1, 0]
    missing = CameraReset("3", {0x2676}, bus)()
    assert not missing.is_done
    assert "no such camera" in missing.detail
    assert [device.n_resets for device in (star, reflector, adapter)] == [0, 1, 0]


def test_a_camera_without_a_number_is_reset_only_if_it_is_the_only_one() -> None:
    ueye = [VirtualDevice(0x1409, 0x1485, ("IDS", "UI-1480", ""), (n,), 1, HIGH, 0x0200) for n in (1, 2)]
    assert CameraReset("4002795734", {0x1409}, VirtualUsb([ueye[0], basler()]))().is_done
    assert ueye[0].n_resets == 1
    both = CameraReset("4002795734", {0x1409}, VirtualUsb(ueye))()
    assert not both.is_done
    assert "2 cameras" in both.detail


@pytest.mark.parametrize(
    ("error", "is_done", "said"),
    [(errno.ENODEV, True, "reset"), (errno.ENOENT, True, "reset"), (errno.EIO, False, "could not be reset")],
)
def test_what_a_reset_comes_to(error: int, is_done: bool, said: str) -> None:
    camera = basler(7, reset_error=error)
    done = CameraReset("7", backend=VirtualUsb([camera]))()
    assert done.is_done == is_done
    assert said in done.detail
    assert camera.opened == 0


def test_a_forbidden_reset_gives_the_rule_to_install() -> None:
    done = CameraReset("7", {0x2676}, VirtualUsb([basler(7, is_forbidden=True)]))()
    assert not done.is_done
    assert udev_rule(0x2676, 0xBA02) in done.detail


def test_a_hung_camera_does_not_tell_its_number_and_is_known_by_its_place() -> None:
    star, reflector = basler(1, ports=(1,)), basler(2, ports=(2,))
    bus = VirtualUsb([star, reflector])
    reset = CameraReset("2", backend=bus)
    star.is_hung = reflector.is_hung = True
    assert reset().is_done
    assert (star.n_resets, reflector.n_resets) == (0, 1)
    assert not CameraReset("3", backend=bus)().is_done


def test_a_camera_that_was_plugged_in_elsewhere_is_known_there() -> None:
    star, reflector = basler(1, ports=(1,)), basler(2, ports=(2,))
    reset = CameraReset("2", backend=VirtualUsb([star, reflector]))
    star.ports, reflector.ports = (2,), (1,)
    assert reset().is_done  # the number counts for more than the place
    reflector.is_hung = True
    assert reset().is_done
    assert (star.n_resets, reflector.n_resets) == (0, 2)
