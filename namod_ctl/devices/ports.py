"""The serial ports of this computer."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports  # type: ignore[import-untyped]

_BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True, slots=True)
class FoundPort:
    """One serial port.

    Attributes
    ----------
    device
        What the config's key `url` takes: /dev/ttyUSB0, COM3.
    stable_name
        A name of the same port that stays when adapters are plugged in in another order; "" where there is none.
    description, serial_number
        Of the adapter behind it, "" where not known.
    usb_ids
        Vendor and product id of the adapter; None for a port that is not on the USB.
    """

    device: str
    stable_name: str
    description: str
    serial_number: str
    usb_ids: tuple[int, int] | None


def list_serial_ports() -> list[FoundPort]:
    """All serial ports with something behind them, in the order of their names."""
    stable = {os.path.realpath(link): str(link) for link in sorted(_BY_ID.glob("*"))}
    return [
        FoundPort(
            device=port.device,
            stable_name=stable.get(os.path.realpath(port.device), ""),
            description="" if port.description in (None, "n/a") else str(port.description),
            serial_number=port.serial_number or "",
            usb_ids=None if port.vid is None or port.pid is None else (int(port.vid), int(port.pid)),
        )
        for port in sorted(list_ports.comports())
    ]


def is_same_port(port: FoundPort, url: str) -> bool:
    """True when a URL of the config means that port, be it by another name."""
    return url in (port.device, port.stable_name) or os.path.realpath(url) == os.path.realpath(port.device)
