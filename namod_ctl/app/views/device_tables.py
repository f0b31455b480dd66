"""What is plugged in, and which entry of the config each device is: as tables, and as JSON for other programs."""

from __future__ import annotations

import os
import socket
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rich.table import Table

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.views.camera_listing import DriverListing
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.ports import FoundPort, is_same_port
from namod_ctl.devices.usb_tree import UsbDevice, UsbKind, UsbTree, is_serial_number

SCHEMA = "namod-devices/1"


DEFAULT_PORTS = {"alpaca": 11111, "indi": 7624}
"""Of servers of cameras, by driver: ASCOM Alpaca API, 3.1; INDI protocol 1.7."""
_THIS_COMPUTER = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class WantedDevice:
    """An entry of the config that names a device.

    Attributes
    ----------
    entry
        The section as the config has it: star_camera, reflector_camera, or actuators.NAME for a bus.
    driver, serial_number, address, device
        As the section says, "" where it does not. The address of a bus is its URL, and its driver is "serial".
    """

    entry: str
    driver: str
    serial_number: str
    address: str
    device: str = ""

    def __str__(self) -> str:
        number = f"serial number {self.serial_number}" if self.serial_number else ""
        parts = [self.driver, number, self.address, self.device]
        return f"{self.entry} ({', '.join(part for part in parts if part)})"

    @property
    def server(self) -> tuple[str, int] | None:
        """Host and port of the server that has the camera; None where there is none, or no sense in its address."""
        if self.driver not in DEFAULT_PORTS:
            return None
        return _host_and_port(self.address, DEFAULT_PORTS[self.driver])

    def is_camera(self, camera: FoundCamera, n_of_driver: int) -> bool:
        """True when the entry means that camera, one of `n_of_driver` that its driver sees."""
        if self.driver not in ("", camera.driver):
            return False
        if self.serial_number:
            return self.serial_number.strip().lower() == camera.serial_number.strip().lower()
        if self.server is not None:
            is_device = not self.device or self.device.isdecimal() or self.device == camera.model
            return is_device and self.server == _host_and_port(camera.address, DEFAULT_PORTS[self.driver])
        if self.address:
            address = f"/dev/video{self.address}" if self.address.isdecimal() else self.address
            return os.path.realpath(address) == os.path.realpath(camera.address)
        return n_of_driver == 1

    def is_on_usb(self, device: UsbDevice) -> bool:
        """True when the entry means that device on the USB, by its serial number."""
        return device.kind is UsbKind.CAMERA and is_serial_number(device.serial_number, self.serial_number)


@dataclass(frozen=True, slots=True)
class Inventory:
    """All that was found, and what the config wants of it.

    `answering` are servers that the config names, `emulated` its cameras that nobody plugs in (`emulated_cameras`).
    """

    listings: Sequence[DriverListing]
    ports: Sequence[FoundPort]
    usb: UsbTree
    wanted: Sequence[WantedDevice] = ()
    answering: Collection[tuple[str, int]] = ()
    emulated: Sequence[str] = ()

    def entries_of_camera(self, camera: FoundCamera) -> list[str]:
        """The config's entries that mean this camera."""
        n = sum(len(listing.cameras) for listing in self.listings if listing.driver == camera.driver)
        return [wanted.entry for wanted in self.wanted if wanted.driver != "serial" and wanted.is_camera(camera, n)]

    def entries_of_port(self, port: FoundPort) -> list[str]:
        """The config's buses on this serial port."""
        return [w.entry for w in self.wanted if w.driver == "serial" and is_same_port(port, w.address)]

    def entries_of_usb(self, device: UsbDevice) -> list[str]:
        """The config's entries that this device on the USB is."""
        ports = [port for port in self.ports if port.serial_number and port.serial_number == device.serial_number]
        of_ports = [entry for port in ports for entry in self.entries_of_port(port)]
        return [wanted.entry for wanted in self.wanted if wanted.is_on_usb(device)] + of_ports

    @property
    def missing(self) -> list[str]:
        """The config's entries that no device was found for, for a person."""
        found = {
            entry for listing in self.listings for camera in listing.cameras for entry in self.entries_of_camera(camera)
        }
        found |= {entry for port in self.ports for entry in self.entries_of_port(port)}
        return [
            f"{w} was not found{self._hint(w)}" for w in self.wanted if w.entry not in found and not self._is_there(w)
        ]

    @property
    def unlisted(self) -> list[str]:
        """The config's entries that no driver lists, though they seem to be there, for a person."""
        return [
            f"{w}: {'the folder is there' if w.driver == 'folder' else 'its server answers'}; whether frames come is "
            f"told by: namod-ctl camera snap {w.entry.removesuffix('_camera')} --config ..."
            for w in self.wanted
            if self._is_there(w)
        ]

    def _is_there(self, wanted: WantedDevice) -> bool:
        """What no driver lists, as it cannot be looked for, but is there: a folder, a server in another network."""
        if wanted.driver == "folder":
            return Path(wanted.address).is_dir()
        return wanted.server in self.answering and not self._neighbours(wanted)

    def _neighbours(self, wanted: WantedDevice) -> list[str]:
        """The names of all cameras that are listed of the entry's server."""
        return [
            camera.model
            for listing in self.listings
            for camera in listing.cameras
            if camera.driver == wanted.driver
            and wanted.server is not None
            and wanted.server == _host_and_port(camera.address, DEFAULT_PORTS[wanted.driver])
        ]

    def _hint(self, wanted: WantedDevice) -> str:
        if any(wanted.entry in self.entries_of_usb(device) for device in self.usb.devices):
            return ", though it is on the USB: install its driver, or end the program that uses it"
        if neighbours := self._neighbours(wanted):
            return f": its server has {', '.join(neighbours)}; correct device in the config"
        if wanted.server is not None:
            return f": no server answers at {wanted.server[0]}:{wanted.server[1]}; start it, or correct the address"
        return "" if wanted.driver != "folder" else ": there is no such folder"


def wanted_devices(config: InstrumentConfig) -> list[WantedDevice]:
    """The devices that a config names; cameras of the twin, and buses in networks or in memory, are none."""
    wanted = []
    for entry, section in (("star_camera", config.star_camera), ("reflector_camera", config.reflector_camera)):
        device = section.device
        if device is None and section.serial_number:
            wanted.append(WantedDevice(entry, "", section.serial_number, ""))
        if device is not None and not device.fed_by_twin:
            named = (section.serial_number or "", device.address or "", device.device or "")
            wanted.append(WantedDevice(entry, device.driver, *named))
    buses = config.actuators.buses if config.actuators is not None else ()
    return wanted + [WantedDevice(f"actuators.{b.name}", "serial", "", b.url) for b in buses if "://" not in b.url]


def emulated_cameras(config: InstrumentConfig) -> list[str]:
    """The cameras of a config that its driver emulates and that show the twin's sky, for a person."""
    sections = (("star_camera", config.star_camera), ("reflector_camera", config.reflector_camera))
    return [
        f"{entry} ({section.device.driver}): emulated, shown the twin's sky"
        for entry, section in sections
        if section.device is not None and section.device.fed_by_twin
    ]


def answering_servers(wanted: Sequence[WantedDevice], timeout_s: float = 1.0) -> set[tuple[str, int]]:
    """Those of the servers named that can be connected to."""
    found = set()
    for server in {one.server for one in wanted} - {None}:
        assert server is not None
        with suppress(OSError), socket.create_connection(server, timeout_s):
            found.add(server)
    return found


def tables(inventory: Inventory) -> Iterator[Table]:
    """Cameras, serial ports and USB, each in a table; those without rows are left out."""
    cameras = _table("Cameras", "driver", "camera", "serial number", "address", "in the config as")
    for listing in inventory.listings:
        for camera in listing.cameras:
            name = " ".join(part for part in (camera.vendor, camera.model) if part)
            entries = ", ".join(inventory.entries_of_camera(camera))
            cameras.add_row(camera.driver, name, camera.serial_number, camera.address, entries)
    ports = _table("Serial ports", "port", "adapter", "serial number", "stable name", "in the config as")
    for port in inventory.ports:
        entries = ", ".join(inventory.entries_of_port(port))
        ports.add_row(port.device, port.description, port.serial_number, port.stable_name, entries)
    usb = _table("USB", "port", "device", "what", "speed", "in the config as")
    for device in inventory.usb.devices:
        entries = ", ".join(inventory.entries_of_usb(device))
        usb.add_row(device.path, device.title, device.kind, str(device.speed), entries)
    yield from (table for table in (cameras, ports, usb) if table.row_count)


def as_json(inventory: Inventory) -> dict[str, Any]:
    """The inventory with the stable names that other programs rely on."""
    return {
        "schema": SCHEMA,
        "cameras": [
            {
                "driver": camera.driver,
                "vendor": camera.vendor,
                "model": camera.model,
                "serial_number": camera.serial_number,
                "address": camera.address,
                "entries": inventory.entries_of_camera(camera),
            }
            for listing in inventory.listings
            for camera in listing.cameras
        ],
        "drivers": [
            {"driver": listing.driver, "n_cameras": len(listing.cameras), "remark": listing.remark}
            for listing in inventory.listings
        ],
        "serial_ports": [
            {
                "port": port.device,
                "stable_name": port.stable_name,
                "adapter": port.description,
                "serial_number": port.serial_number,
                "entries": inventory.entries_of_port(port),
            }
            for port in inventory.ports
        ],
        "usb": [
            {
                "kind": device.kind.value,
                "vendor_id": f"{device.vendor_id:04x}",
                "product_id": f"{device.product_id:04x}",
                "vendor": device.vendor,
                "product": device.product,
                "serial_number": device.serial_number,
                "path": device.path,
                "hub": device.hub,
                "speed": str(device.speed),
                "entries": inventory.entries_of_usb(device),
            }
            for device in inventory.usb.devices
        ],
        "warnings": list(inventory.usb.warnings),
        "emulated": list(inventory.emulated),
        "missing": inventory.missing,
    }


def _host_and_port(address: str, default_port: int) -> tuple[str, int] | None:
    try:
        parts = urlsplit(f"//{address}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not host:
        return None
    return "localhost" if host in _THIS_COMPUTER else host, default_port if port is None else port


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table
