"""A USB in memory under the real pyusb: devices answer with descriptors, byte by byte as the specification lays out.

Plug, unplug, hang, forbid: what a real bus does to a program, done by a test.
"""

from __future__ import annotations

import errno
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

LOW, FULL, HIGH, SUPER = 1, 2, 3, 4
U3V, UVC, CDC, VENDOR, HID = (0xEF, 0x05), (0x0E, 0x01), (0x02, 0x02), (0xFF, 0xFF), (0x03, 0x00)

# what a super speed device answers at a USB 2 port: BOS with USB 2 extension (LPM) and SuperSpeed capability (10 bytes)
BOS_SUPER_SPEED = bytes.fromhex("050f160002" + "07100202000000" + "0a1003000e00010a8000")
# a full speed device with WebUSB: version 2.1, and no super speed in it
BOS_WEBUSB = bytes.fromhex("050f1d0001" + "18100500" + "38b60834a909a0478bfda0768815b665" + "00010101")


@dataclass(eq=False)
class VirtualDevice:
    """One device; `strings` are manufacturer, product and serial number."""

    vendor_id: int
    product_id: int
    strings: tuple[str, str, str]
    ports: tuple[int, ...]
    bus: int = 2
    speed: int = SUPER
    version: int = 0x0320
    classes: tuple[tuple[int, int], ...] = (VENDOR,)
    bos: bytes = b""
    device_class: int = 0
    is_forbidden: bool = False
    is_hung: bool = False
    n_resets: int = 0
    reset_error: int | None = None
    is_mended_by_reset: bool = True
    opened: int = 0

    def control(self, request_type: int, request: int, value: int, data: Any) -> int:
        """GET_DESCRIPTOR, answered as on the wire (USB 2.0, 9.4.3)."""
        if self.is_hung:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        assert (request_type, request) == (0x80, 0x06)
        kind, index = value >> 8, value & 0xFF
        if kind == 0x03 and index == 0:
            answer = bytes([4, 3, 0x09, 0x04])
        elif kind == 0x03:
            text = self.strings[index - 1].encode("utf-16-le")
            answer = bytes([2 + len(text), 3]) + text
        elif kind == 0x0F and self.bos:
            answer = self.bos
        else:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        data[: len(answer)] = array("B", answer[: len(data)])
        return min(len(answer), len(data))


@dataclass(eq=False)
class VirtualUsb(usb.backend.IBackend):  # type: ignore[misc]
    """A backend of pyusb whose bus is a list."""

    devices: list[VirtualDevice] = field(default_factory=list)

    def enumerate_devices(self) -> Iterator[VirtualDevice]:
        yield from list(self.devices)

    def get_device_descriptor(self, dev: VirtualDevice) -> SimpleNamespace:
        numbers = [n + 1 if text else 0 for n, text in enumerate(dev.strings)]
        raw = struct.pack(
            "<BBHBBBBHHHBBBB", 18, 1, dev.version, dev.device_class, 0, 0, 9, dev.vendor_id, dev.product_id, 0x0100,
            *numbers, 1,
        )  # fmt: skip
        names = (
            "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor "
            "idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
        )
        known = dict(zip(names.split(), struct.unpack("<BBHBBBBHHHBBBB", raw), strict=True))
        address = 2 + self.devices.index(dev) if dev in self.devices else 99
        return SimpleNamespace(
            **known, bus=dev.bus, address=address, port_number=dev.ports[-1], port_numbers=dev.ports, speed=dev.speed
        )

    def get_configuration_descriptor(self, dev: VirtualDevice, config: int) -> SimpleNamespace:
        if config > 0:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=9 + 9 * len(dev.classes), bNumInterfaces=len(dev.classes),
            bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=112, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: VirtualDevice, intf: int, alt: int, config: int) -> SimpleNamespace:
        if intf >= len(dev.classes) or alt > 0:
            raise IndexError(intf)
        code, subclass = dev.classes[intf]
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0, bNumEndpoints=0,
            bInterfaceClass=code, bInterfaceSubClass=subclass, bInterfaceProtocol=0, iInterface=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: VirtualDevice) -> VirtualDevice:
        if dev not in self.devices:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
        if dev.is_forbidden:
            raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        dev.opened += 1
        return dev

    def close_device(self, dev_handle: VirtualDevice) -> None:
        dev_handle.opened -= 1

    def ctrl_transfer(
        self, dev_handle: VirtualDevice, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any,
        timeout: int,
    ) -> int:  # fmt: skip
        assert timeout <= 1000
        return dev_handle.control(bmRequestType, bRequest, wValue, data)

    def get_configuration(self, dev_handle: VirtualDevice) -> int:
        return 1

    def reset_device(self, dev_handle: VirtualDevice) -> None:
        dev_handle.n_resets += 1
        dev_handle.is_hung = dev_handle.is_hung and not dev_handle.is_mended_by_reset
        if dev_handle.reset_error is not None:
            raise usb.core.USBError("reset", -5, dev_handle.reset_error)


def basler(serial_number: int = 21979447, **other: Any) -> VirtualDevice:
    """A Basler ace at a USB 3 port of the computer; its number on the USB is its GUID."""
    known = {"ports": (1,), "classes": (U3V, U3V)} | other
    return VirtualDevice(0x2676, 0xBA02, ("Basler", "acA2500-14um", f"2676{serial_number:08X}"), **known)


def ftdi(**other: Any) -> VirtualDevice:
    """An FTDI adapter, which has classes of its own."""
    known = {"ports": (3,), "bus": 1, "speed": FULL, "version": 0x0200} | other
    return VirtualDevice(0x0403, 0x6001, ("FTDI", "FT232R USB UART", "A50285BI"), **known)
