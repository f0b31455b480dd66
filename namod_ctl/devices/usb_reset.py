"""The last resort for a camera that does not answer: as if its plug had been taken out and in again."""

from __future__ import annotations

import errno
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import usb.backend  # type: ignore[import-untyped]
import usb.core  # type: ignore[import-untyped]
import usb.util  # type: ignore[import-untyped]

from namod_ctl.devices.usb_tree import (
    NO_LIBUSB,
    UsbKind,
    is_serial_number,
    of_interest,
    permission_remedy,
    serial_number_of,
)

_GONE = (errno.ENOENT, errno.ENODEV)
"""libusb_reset_device: after the reset the device came up anew, as after a plug was put in."""

USB_DRIVERS: dict[str, frozenset[int]] = {
    "pylon": frozenset({0x2676}),
    "ueye": frozenset({0x1409}),
    "genicam": frozenset(),
    "opencv": frozenset(),
}
"""Drivers whose cameras can be on the USB, and the vendor ids that are theirs alone."""


@dataclass(frozen=True, slots=True)
class UsbReset:
    """What came of it: whether a device was reset, and for a person, what was done or stood in the way."""

    is_done: bool
    detail: str


class CameraReset:
    """Resets one camera on the USB, as often as it is called.

    The camera is known by its serial number. One that hangs does not even tell that: then it is the device of the same
    maker and type at the place where it was last seen in good health, of which the first time is now. A camera that
    never tells its number (uEye of the first generation) is taken to be the only one of its makers.

    Parameters
    ----------
    vendor_ids
        USB ids of the makers whose cameras it can be; empty: its serial number alone tells.
    """

    def __init__(
        self,
        serial_number: str | None,
        vendor_ids: Collection[int] = (),
        backend: usb.backend.IBackend | None = None,
    ) -> None:
        self._serial_number, self._vendor_ids, self._backend = serial_number, vendor_ids, backend
        self._place: _Place | None = None
        with suppress(usb.core.NoBackendError, usb.core.USBError, NotImplementedError):
            self._candidates()

    def __call__(self) -> UsbReset:
        """Reset it, if it is there; never raises for what the USB does."""
        try:
            chosen = self._candidates()
        except usb.core.NoBackendError:
            return UsbReset(False, NO_LIBUSB)
        except (usb.core.USBError, NotImplementedError) as error:
            return UsbReset(False, f"the USB cannot be looked at: {error}")
        if len(chosen) != 1:
            wanted = f"serial number {self._serial_number}" if self._serial_number else "no serial number in the config"
            seen = f"{len(chosen)} cameras it could be" if chosen else "no such camera"
            return UsbReset(False, f"not reset: {seen} on the USB ({wanted})")
        return _reset(chosen[0])

    def _candidates(self) -> list[Any]:
        cameras = [device for device, kind in of_interest(self._backend) if kind is UsbKind.CAMERA]
        numbers = [serial_number_of(device) for device in cameras]
        for device in cameras:
            usb.util.dispose_resources(device)
        both = list(zip(cameras, numbers, strict=True))
        if self._serial_number is not None:
            named = [device for device, number in both if is_serial_number(number, self._serial_number)]
            if named:
                self._place = _place_of(named[0])
                return named
        silent = [device for device, number in both if not number]
        there = [device for device in silent if _place_of(device) == self._place]
        if there:
            return there
        possible = [device for device, _ in both] if self._serial_number is None else silent
        return [device for device in possible if device.idVendor in self._vendor_ids]


_Place = tuple[int, int, int | None, tuple[int, ...]]
"""Vendor and product, bus and ports: what stays when a device does not answer."""


def _place_of(device: Any) -> _Place:
    return device.idVendor, device.idProduct, device.bus, tuple(device.port_numbers or ())


def _reset(device: Any) -> UsbReset:
    name = f"{device.idVendor:04x}:{device.idProduct:04x}"
    try:
        device.reset()
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.EPERM):
            remedy = permission_remedy(device.idVendor, device.idProduct)
            return UsbReset(False, f"no permission to reset {name} on the USB: {remedy}")
        if error.errno not in _GONE:
            return UsbReset(False, f"{name} could not be reset on the USB: {error}")
    except NotImplementedError:
        return UsbReset(False, f"{name} could not be reset: this system's USB cannot do that")
    finally:
        usb.util.dispose_resources(device)
    return UsbReset(True, f"{name} reset on the USB")


def reset_for(driver: str, serial_number: str | None) -> CameraReset | None:
    """How a `Lifeline` resets a camera of that driver; None when there is no way to do so."""
    if driver not in USB_DRIVERS or not (serial_number or USB_DRIVERS[driver]):
        return None
    return CameraReset(serial_number, USB_DRIVERS[driver])
