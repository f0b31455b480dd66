"""Serial ports as pyserial finds them, and their names."""

from __future__ import annotations

from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from namod_ctl.devices import ports
from namod_ctl.devices.ports import FoundPort, is_same_port, list_serial_ports


def found_by_pyserial(device: str, **known: object) -> ListPortInfo:
    port = ListPortInfo(device)
    for key, value in known.items():
        setattr(port, key, value)
    return port


def test_ports_of_adapters_and_of_the_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device, by_id = tmp_path / "ttyUSB1", tmp_path / "by-id"
    device.touch()
    by_id.mkdir()
    (by_id / "usb-FTDI_A50285BI-if00-port0").symlink_to(device)
    adapter = found_by_pyserial(
        str(device), vid=0x0403, pid=0x6001, serial_number="A50285BI", description="FT232R USB UART"
    )
    monkeypatch.setattr(ports, "_BY_ID", by_id)
    monkeypatch.setattr(list_ports, "comports", lambda: [adapter, found_by_pyserial("/dev/ttyS9")])
    plain, usb = list_serial_ports()
    assert plain == FoundPort("/dev/ttyS9", "", "", "", None)
    stable = str(by_id / "usb-FTDI_A50285BI-if00-port0")
    assert usb == FoundPort(str(device), stable, "FT232R USB UART", "A50285BI", (0x0403, 0x6001))
    assert is_same_port(usb, str(device))
    assert is_same_port(usb, stable)
    assert not is_same_port(usb, str(tmp_path / "ttyUSB2"))
    assert not is_same_port(plain, str(device))


def test_this_computer_can_be_asked() -> None:
    assert all(port.device for port in list_serial_ports())
