"""The USB as the computer sees it: cameras and serial adapters, where they are plugged in, and what is wrong there.

What a device is, it says itself, by the classes of its interfaces (USB3 Vision, UVC, CDC); makers whose devices keep
that to themselves are known by their vendor id.
"""

from __future__ import annotations

import errno
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any

import usb.backend  # type: ignore[import-untyped]
import usb.control  # type: ignore[import-untyped]
import usb.core  # type: ignore[import-untyped]
import usb.util  # type: ignore[import-untyped]

# usb.ids, version 2025.07.26 (linux-usb.org); but 1618 and 20e7, which it does not list, as QHYCCD and Atik use them
CAMERA_MAKERS = {
    0x03C3: "ZWO",
    0x0D97: "Santa Barbara Instrument Group",
    0x0F18: "Finger Lakes Instrumentation",
    0x1278: "Starlight Xpress",
    0x1409: "IDS Imaging Development Systems",
    0x1618: "QHYCCD",
    0x164C: "Matrix Vision",
    0x199E: "The Imaging Source Europe",
    0x1AB2: "Allied Vision",
    0x1E10: "Point Grey Research",
    0x20E7: "Atik",
    0x20F7: "XIMEA",
    0x2676: "Basler AG",
}
# Chips that have no class of their own, by usb.ids; the newer PL2303 (23b3 to 23f3) by Linux' pl2303.h
SERIAL_CHIPS = {
    0x0403: ("FTDI", frozenset({0x6001, 0x6010, 0x6011, 0x6014, 0x6015})),
    0x067B: ("Prolific", frozenset({0x2303, 0x23A3, 0x23B3, 0x23C3, 0x23D3, 0x23E3, 0x23F3})),
    0x10C4: ("Silicon Labs", frozenset({0xEA60, 0xEA61, 0xEA63, 0xEA70, 0xEA71})),
    0x1A86: ("QinHeng", frozenset({0x5523, 0x7522, 0x7523})),
}

# USB class codes (usb.org, Defined Class Codes): class, subclass
_VIDEO_CLASS = 0x0E
_HUB_CLASS = 0x09
_CDC_ACM = (0x02, 0x02)
_USB3_VISION = (0xEF, 0x05)
_HID_CLASS = 0x03

# USB 3.2, 9.6.2: binary device object store, and its capability for super speed
_BOS, _BOS_HEAD_SIZE, _DEVICE_CAPABILITY, _SUPER_SPEED = 0x0F, 5, 0x10, 0x03
_GET_DESCRIPTOR = 0x06
_USB_3, _USB_2_1 = 0x0300, 0x0210
_LANGUAGES_SIZE = 254
_TIMEOUT_MS = 250  # for a descriptor, which comes in 1 ms; a device that hangs must not hold up the list

UDEV_FILE = "/etc/udev/rules.d/60-namod-ctl.rules"
NO_LIBUSB = (
    "the USB cannot be looked at: libusb is missing; install it with apt install libusb-1.0-0, "
    "or pip install libusb-package where there is no package of the system"
)


class UsbKind(StrEnum):
    """What a device is to us."""

    CAMERA = "camera"
    SERIAL = "serial adapter"


class UsbSpeed(IntEnum):
    """Signalling rate of a connection; the numbers are libusb's."""

    UNKNOWN = 0
    LOW = 1
    FULL = 2
    HIGH = 3
    SUPER = 4
    SUPER_PLUS = 5
    SUPER_PLUS_X2 = 6

    def __str__(self) -> str:
        return _SPEED_TEXT[self]


_SPEED_TEXT = {
    UsbSpeed.UNKNOWN: "unknown speed",
    UsbSpeed.LOW: "USB 1, 1.5 Mbit/s",
    UsbSpeed.FULL: "USB 1, 12 Mbit/s",
    UsbSpeed.HIGH: "USB 2, 480 Mbit/s",
    UsbSpeed.SUPER: "USB 3, 5 Gbit/s",
    UsbSpeed.SUPER_PLUS: "USB 3, 10 Gbit/s",
    UsbSpeed.SUPER_PLUS_X2: "USB 3, 20 Gbit/s",
}

_BEFORE_USB_3 = (UsbSpeed.LOW, UsbSpeed.FULL, UsbSpeed.HIGH)


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """One camera or serial adapter.

    Attributes
    ----------
    vendor, product, serial_number
        As the device says; "" where it does not, or may not be asked.
    bus
        Number of the bus; each controller has one for USB 2 and one for USB 3.
    ports
        Ports that lead to it, from the controller on: all but the last are those of hubs. Empty where not known.
    is_usb3_capable
        It can run at USB 3 speed, whether it does or not. None: it did not say.
    is_forbidden
        We may not open it: `udev_rule` says what to install.
    """

    kind: UsbKind
    vendor_id: int
    product_id: int
    vendor: str
    product: str
    serial_number: str
    bus: int
    ports: tuple[int, ...]
    speed: UsbSpeed
    is_usb3_capable: bool | None
    is_forbidden: bool

    @property
    def path(self) -> str:
        """Bus and ports as Linux writes them: 2-1.4 is port 4 of the hub at port 1 of bus 2."""
        return f"{self.bus}-{'.'.join(map(str, self.ports)) or '?'}"

    @property
    def hub(self) -> str:
        """Path of the hub it is plugged into; "" at one of the computer's own ports."""
        return f"{self.bus}-{'.'.join(map(str, self.ports[:-1]))}" if len(self.ports) > 1 else ""

    @property
    def title(self) -> str:
        """For people: vendor, product and serial number."""
        names = " ".join(part for part in (self.vendor, self.product) if part)
        ids = f"{self.vendor_id:04x}:{self.product_id:04x}"
        serial = f", serial number {self.serial_number}" if self.serial_number else ""
        return f"{names or self.kind} ({ids}{serial})"


@dataclass(frozen=True, slots=True)
class UsbTree:
    """Cameras and serial adapters in the order of their paths, and what a person should know about them."""

    devices: tuple[UsbDevice, ...]
    warnings: tuple[str, ...]


def read_usb_tree(backend: usb.backend.IBackend | None = None) -> UsbTree:
    """What is on the USB; without libusb nothing, with a warning that says what to install."""
    try:
        found = [_described(device, kind) for device, kind in of_interest(backend)]
    except usb.core.NoBackendError:
        return UsbTree((), (NO_LIBUSB,))
    except (usb.core.USBError, NotImplementedError) as error:
        return UsbTree((), (f"the USB cannot be looked at: {error}",))
    devices = tuple(sorted(found, key=lambda device: (device.bus, device.ports)))
    return UsbTree(devices, tuple(usb_warnings(devices)))


def of_interest(backend: usb.backend.IBackend | None = None) -> Iterator[tuple[Any, UsbKind]]:
    """pyusb's devices that are cameras or serial adapters, and which of both.

    Raises
    ------
    usb.core.NoBackendError, usb.core.USBError
        The USB cannot be looked at.
    """
    for device in usb.core.find(find_all=True, backend=backend):
        device.default_timeout = _TIMEOUT_MS
        kind = _kind(device)
        if kind is not None:
            yield device, kind


def serial_number_of(device: Any) -> str:
    """The serial number that a pyusb device says it has; "" when it says none, or may not be opened."""
    return _string(device, device.iSerialNumber)


def is_serial_number(usb_serial: str, camera_serial: str) -> bool:
    """True when a device on the USB is the camera of that serial number.

    A USB3 Vision camera's number on the USB is made of its maker's id (4 hexadecimal digits) and its own number, in
    8 more (USB3 Vision 1.0, device GUID); makers such as Basler print the latter in decimal.
    """
    ours, theirs = camera_serial.strip().upper().lstrip("0"), usb_serial.strip().upper()
    if not ours or not theirs:
        return False
    if ours in (theirs, theirs.lstrip("0")):
        return True
    is_guid = len(theirs) == 12 and all(digit in "0123456789ABCDEF" for digit in theirs)
    return is_guid and ours.isdecimal() and int(theirs[4:], 16) == int(ours)


def udev_rule(vendor_id: int, product_id: int | None = None) -> str:
    """What to install so that people who are logged in, or in the group plugdev, may use a device on Linux."""
    product = "" if product_id is None else f', ATTR{{idProduct}}=="{product_id:04x}"'
    return (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor_id:04x}"{product}, MODE="0660", GROUP="plugdev", TAG+="uaccess"'
    )


def permission_remedy(vendor_id: int, product_id: int) -> str:
    """How to get the permission to use a device, for a person."""
    return (
        f"write the line\n    {udev_rule(vendor_id, product_id)}\ninto {UDEV_FILE}, run\n"
        "    sudo udevadm control --reload-rules && sudo udevadm trigger --subsystem-match=usb\n"
        "and take the plug out and in again; over ssh also be in the group plugdev (sudo usermod -aG plugdev $USER)"
    )


def usb_warnings(devices: Sequence[UsbDevice]) -> Iterator[str]:
    """What is wrong with how the devices are plugged in, one text each."""
    cameras = [device for device in devices if device.kind is UsbKind.CAMERA]
    for device in cameras:
        if device.speed in _BEFORE_USB_3 and device.is_usb3_capable:
            yield (
                f"{device.title} at {device.path}: a USB 3 camera that runs at {device.speed}; plug it into a USB 3 "
                "port (blue, or marked SS) with a USB 3 cable, and push the plug in quickly and all the way"
            )
    by_hub = _sharing_hubs(cameras)
    for hub, sharing in by_hub.items():
        yield (
            f"{_listed(sharing)} share the hub {hub}: they take each other's bandwidth and fail together; "
            "plug one of them into a port of the computer"
        )
    by_bus: dict[int, list[UsbDevice]] = defaultdict(list)
    for device in cameras:
        if device.speed in _BEFORE_USB_3:
            by_bus[device.bus].append(device)
    for bus, sharing in by_bus.items():
        if len(sharing) > 1 and sharing not in by_hub.values():
            yield (
                f"{_listed(sharing)} share the controller of bus {bus}, {sharing[0].speed} in all: frames may get "
                "lost; plug one of them into a port of another controller, or both into USB 3 ports"
            )
    for device in devices:
        if device.is_forbidden and device.kind is UsbKind.CAMERA:
            remedy = permission_remedy(device.vendor_id, device.product_id)
            yield f"{device.title} at {device.path}: no permission to use it; {remedy}"


def _sharing_hubs(cameras: Sequence[UsbDevice]) -> dict[str, list[UsbDevice]]:
    """Cameras that share a hub, by its path, whether at its own ports or at those of hubs behind it."""
    behind: dict[str, list[UsbDevice]] = defaultdict(list)
    for device in cameras:
        for depth in range(1, len(device.ports)):
            behind[f"{device.bus}-{'.'.join(map(str, device.ports[:depth]))}"].append(device)
    shared = {hub: group for hub, group in behind.items() if len(group) > 1}
    # of hubs behind each other with the same cameras, the last one is where they can be parted
    return {
        hub: group
        for hub, group in shared.items()
        if not any(other.startswith(f"{hub}.") and shared[other] == group for other in shared)
    }


def _listed(devices: Sequence[UsbDevice]) -> str:
    return " and ".join(f"{device.title} at {device.path}" for device in devices)


def _kind(device: Any) -> UsbKind | None:
    if device.bDeviceClass == _HUB_CLASS:
        return None
    classes = _interface_classes(device)
    if _USB3_VISION in classes or any(code == _VIDEO_CLASS for code, _ in classes):
        return UsbKind.CAMERA
    if device.idVendor in CAMERA_MAKERS:  # which also make focusers and filter wheels, all of them HID
        return None if classes and all(code == _HID_CLASS for code, _ in classes) else UsbKind.CAMERA
    _, products = SERIAL_CHIPS.get(device.idVendor, ("", frozenset()))
    return UsbKind.SERIAL if _CDC_ACM in classes or device.idProduct in products else None


def _interface_classes(device: Any) -> set[tuple[int, int]]:
    try:
        return {(i.bInterfaceClass, i.bInterfaceSubClass) for configuration in device for i in configuration}
    except (usb.core.USBError, NotImplementedError):  # a device that sleeps, or has just gone
        return set()


def _described(device: Any, kind: UsbKind) -> UsbDevice:
    is_forbidden = _is_forbidden(device)
    vendor = "" if is_forbidden else _string(device, device.iManufacturer)
    known, _ = SERIAL_CHIPS.get(device.idVendor, (CAMERA_MAKERS.get(device.idVendor, ""), ()))
    speed = device.speed if device.speed in set(UsbSpeed) else UsbSpeed.UNKNOWN
    described = UsbDevice(
        kind=kind,
        vendor_id=device.idVendor,
        product_id=device.idProduct,
        vendor=vendor or known,
        product="" if is_forbidden else _string(device, device.iProduct),
        serial_number="" if is_forbidden else serial_number_of(device),
        bus=device.bus or 0,
        ports=tuple(device.port_numbers or ()),
        speed=UsbSpeed(speed),
        is_usb3_capable=_is_usb3_capable(device, is_forbidden=is_forbidden),
        is_forbidden=is_forbidden,
    )
    usb.util.dispose_resources(device)
    return described


def _is_forbidden(device: Any) -> bool:
    try:
        usb.util.get_langids(device)
    except usb.core.USBError as error:
        return error.errno in (errno.EACCES, errno.EPERM)
    except NotImplementedError:  # Windows without a driver for it, of which udev knows nothing
        return False
    return False


def _string(device: Any, index: int) -> str:
    try:
        return (usb.util.get_string(device, index) or "").strip().strip("\0")
    except (usb.core.USBError, NotImplementedError, ValueError):  # ValueError: it has no strings, or garbled ones
        return ""


def _is_usb3_capable(device: Any, *, is_forbidden: bool) -> bool | None:
    """At a USB 2 port a USB 3 device says that it is of version 2.1 (USB 3.2, 9.6.1): its capabilities tell."""
    if device.bcdUSB >= _USB_3 or _USB3_VISION in _interface_classes(device):
        return True
    if device.bcdUSB < _USB_2_1:
        return False
    return None if is_forbidden else _has_super_speed(device)


def _has_super_speed(device: Any) -> bool | None:
    try:
        head = usb.control.get_descriptor(device, _BOS_HEAD_SIZE, _BOS, 0)
        size = head[2] + 256 * head[3] if len(head) == _BOS_HEAD_SIZE else 0
        store = bytes(usb.control.get_descriptor(device, size, _BOS, 0)) if size > _BOS_HEAD_SIZE else b""
    except (usb.core.USBError, NotImplementedError):
        return None
    position = _BOS_HEAD_SIZE
    while position + 3 <= len(store) and store[position] >= 3:
        if store[position + 1] == _DEVICE_CAPABILITY and store[position + 2] == _SUPER_SPEED:
            return True
        position += store[position]
    return False
