"""What is Zaber's own in its driver: what it sends, flags in words, and devices that have less than others."""

from __future__ import annotations

import math

import pytest

from firmware_protocols import zaber_ascii as zaber
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.links import LineSettings, ZaberLink
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.devices.zaber_drive import ZaberDrive


class Device:
    """Answers from a table of data by words; what is not in it is rejected."""

    def __init__(self) -> None:
        self.flags: list[str] = []
        self.commands: list[zaber.Command] = []
        self.data = {"get pos": "2000", "get driver.temperature": "24.5", "stop": "0", "home": "0"}

    def receive(self, line: bytes) -> bytes:
        command = zaber.decode_command(line.strip())
        self.commands.append(command)
        data = self.data.get(command.words)
        if command.words == "warnings":
            data = " ".join([f"{len(self.flags):02d}", *self.flags])
        flag = self.flags[0] if self.flags else zaber.NO_WARNING
        return zaber.Reply(
            command.device,
            command.axis,
            data is not None,
            zaber.Status.IDLE,
            flag,
            "BADCOMMAND" if data is None else data,
            command.message_id,
        ).encode()

    @property
    def words(self) -> list[str]:
        return [command.words for command in self.commands]


@pytest.fixture
def device() -> Device:
    return Device()


@pytest.fixture
def drive(device: Device) -> ZaberDrive:
    link = ZaberLink(LoopbackTransport("loopback://z", device.receive), LineSettings())
    return ZaberDrive(
        link,
        4,
        1,
        steps_per_m=-1e6,
        range_m=(-0.01, 0.01),
        speed_m_per_s=0.001,
        acceleration_m_per_s2=0.5,
    )


def test_speeds_in_the_units_of_the_manual(device, drive):
    device.data |= {"set maxspeed 1638": "0", "set accel 81": "0"}
    # 1000 steps/s * 1.6384 and 500000 steps/s2 * 1.6384e-4, rounded down
    drive.configure()
    assert device.words == ["set maxspeed 1638", "set accel 81"]


def test_position_and_temperature(drive):
    state = drive.state()
    assert state.position_m == pytest.approx(-0.002)
    assert state.temperature_k == pytest.approx(297.65)
    assert state.is_homed


def test_no_thermometer(device, drive):
    del device.data["get driver.temperature"]
    assert drive.state().temperature_k is None
    n_commands = len(device.commands)
    assert drive.state().temperature_k is None
    assert "get driver.temperature" not in device.words[n_commands:]


def test_all_flags_count_and_notes_are_no_faults(device, drive):
    device.flags = ["FS", "WT", "WR", "NI"]
    state = drive.state()
    assert state.faults == ("stalled and stopped", "controller temperature high")
    assert not state.is_homed
    assert math.isnan(state.position_m)


def test_unhomed_behind_a_graver_flag(device, drive):
    device.flags = ["WL", "WH"]
    state = drive.state()
    assert state.faults == ("unexpected limit switch",)
    assert not state.is_homed


def test_a_driver_that_is_off_is_switched_on_by_clearing_only(device, drive):
    device.data |= {"warnings clear": "0", "driver enable": "0"}
    drive.clear_faults()
    assert "driver enable" not in device.words
    device.flags = ["FO"]
    assert drive.state().faults == ("driver disabled",)
    drive.clear_faults()
    assert device.words[-1] == "driver enable"


def test_rejections_are_told_in_words(drive):
    with pytest.raises(
        DeviceFaultError, match=r"Zaber device 4 axis 1 on loopback://z refuses 'move abs -3000': unknown command"
    ):
        drive.start_move(0.003)


def test_a_position_that_is_no_number(device, drive):
    device.data["get pos"] = "nowhere"
    with pytest.raises(CommunicationError, match="'nowhere' is no number"):
        drive.state()


def test_identity_comes_from_the_device_not_the_axis(device, drive):
    device.data |= {"get device.id": "30211", "get version": "7.38", "get system.serial": "52001"}
    assert drive.identity() == "Zaber device id 30211 firmware 7.38 serial number 52001"
    assert {command.axis for command in device.commands} == {0}
