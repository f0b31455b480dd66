"""What is TMCL's own in its driver: what it sends, and modules that have less than others."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from firmware_protocols import tmcl
from firmware_protocols.tmcl import AxisParameter, Command, Status
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.links import LineSettings, TmclLink
from namod_ctl.devices.tmcl_drive import HOMED, HOMED_VARIABLE, ReferenceSearchSettings, TmclDrive
from namod_ctl.devices.transports import LoopbackTransport

MODULE, MOTOR = 9, 2


class Module:
    """Answers from a table of values; whatever is in `refused` with that status."""

    def __init__(self) -> None:
        self.requests: list[tmcl.Request] = []
        self.values: dict[tuple[int, int, int], int] = {
            (Command.GAP, AxisParameter.POSITION_REACHED, MOTOR): 1,
            (Command.GGP, HOMED_VARIABLE + MOTOR, tmcl.USER_BANK): HOMED,
        }
        self.refused: dict[tuple[int, int], Status] = {}
        self.is_heard = True

    def receive(self, data: bytes) -> bytes:
        request = tmcl.Request.decode(data)
        self.requests.append(request)
        if request.command == Command.SGP:
            self.values[Command.GGP, request.type, request.motor] = request.value
        status = self.refused.get((request.command, request.type), Status.OK)
        value = self.values.get((request.command, request.type, request.motor), 0)
        return tmcl.Reply(2, request.module, status, request.command, value).encode() if self.is_heard else b""

    def set(self, parameter: AxisParameter, value: int) -> None:
        self.values[Command.GAP, parameter, MOTOR] = value

    def asked(self, command: Command, type_: int) -> list[int]:
        return [asked.value for asked in self.requests if (asked.command, asked.type) == (command, type_)]


@pytest.fixture
def module() -> Module:
    return Module()


def drive_of(module: Module, homing: ReferenceSearchSettings | None = None, link: TmclLink | None = None) -> TmclDrive:
    link = link or TmclLink(LoopbackTransport("loopback://m", module.receive), LineSettings())
    return TmclDrive(
        link,
        MODULE,
        MOTOR,
        steps_per_m=-1e6,
        range_m=(-0.01, 0.01),
        speed_m_per_s=0.001,
        acceleration_m_per_s2=0.005,
        homing=homing,
    )


def test_speeds_are_sent_in_steps_whatever_the_sign_of_the_scale(module):
    drive_of(module, ReferenceSearchSettings(7, 0.0005, 0.0001)).configure()
    sent = {asked.type: asked.value for asked in module.requests if asked.command == Command.SAP}
    assert sent == {
        AxisParameter.MAX_SPEED: 1000,
        AxisParameter.MAX_ACCELERATION: 5000,
        AxisParameter.REFERENCE_SEARCH_MODE: 7,
        AxisParameter.REFERENCE_SEARCH_SPEED: 500,
        AxisParameter.REFERENCE_SWITCH_SPEED: 100,
    }
    assert {asked.motor for asked in module.requests if asked.command == Command.SAP} == {MOTOR}


def test_a_target_that_does_not_stick_is_sent_again_and_then_the_drive_is_stopped(module):
    module.set(AxisParameter.TARGET_POSITION, 1234)
    drive = drive_of(module)
    with pytest.raises(DeviceFaultError, match="does not take -5000 steps"):
        drive.start_move(0.005)
    targets = module.asked(Command.MVP, tmcl.MoveType.ABS)
    assert targets == [-5000] * len(targets)
    assert len(targets) > 1
    assert module.requests[-1].command == Command.MST


def test_refusals_are_told_in_words(module):
    module.refused[Command.MVP, tmcl.MoveType.ABS] = Status.INVALID_VALUE
    with pytest.raises(DeviceFaultError, match=r"TMCL module 9 motor 2 on loopback://m refuses MVP 0: invalid value"):
        drive_of(module).start_move(0.005)


def test_a_module_without_thermometer_and_error_flags_is_asked_for_them_once(module):
    module.refused = {
        (Command.GIO, tmcl.TEMPERATURE_PORT): Status.INVALID_COMMAND,
        (Command.GAP, AxisParameter.EXTENDED_ERROR_FLAGS): Status.WRONG_TYPE,
        (Command.GAP, AxisParameter.DRIVER_ERROR_FLAGS): Status.WRONG_TYPE,
    }
    drive = drive_of(module)
    state = drive.state()
    n_requests = len(module.requests)
    assert state.temperature_k is None
    assert state.faults == ()
    assert drive.state() == state
    new = {(asked.command, asked.type) for asked in module.requests[n_requests:]}
    assert not new & set(module.refused)


def test_error_flags_in_words(module):
    # bits 0 and 1 of the extended flags; of the driver's flags 7 is standstill and no fault, 1 is overtemperature
    module.set(AxisParameter.EXTENDED_ERROR_FLAGS, 0b11)
    module.set(AxisParameter.DRIVER_ERROR_FLAGS, 0b1000_0010)
    assert drive_of(module).state().faults == (
        "motor stopped by stall detection",
        "motor stopped by encoder deviation",
        "overtemperature shutdown",
    )


def test_temperature(module):
    module.values[Command.GIO, tmcl.TEMPERATURE_PORT, tmcl.ANALOG_BANK] = 31
    assert drive_of(module).state().temperature_k == pytest.approx(304.15)


@pytest.mark.parametrize(("target", "has_fault"), [(-4000, True), (4000, False)])
def test_only_the_limit_switch_in_the_way_is_a_fault(module, target, has_fault):
    module.set(AxisParameter.LEFT_LIMIT_SWITCH, 1)
    module.set(AxisParameter.TARGET_POSITION, target)
    module.set(AxisParameter.POSITION_REACHED, 0)
    drive = drive_of(module)
    drive.start_move(-target / 1e6)
    state = drive.state()
    assert ("left limit switch hit" in state.faults) is has_fault
    assert state.is_moving is not has_fault


def test_a_search_that_could_not_be_begun_does_not_count_as_ended(module):
    module.refused[Command.RFS, tmcl.ReferenceSearch.START] = Status.COMMAND_NOT_AVAILABLE
    drive = drive_of(module)
    with pytest.raises(DeviceFaultError, match="refuses RFS 0"):
        drive.start_homing()
    assert not drive.state().is_homed
    assert not drive.state().is_homed


def test_identity(module):
    module.values[Command.GET_FIRMWARE_VERSION, 1, 0] = 0x17DE0115
    assert drive_of(module).identity() == "TMCM-6110 firmware 1.21"


def test_a_stop_of_a_drive_that_was_seen_to_seek_nothing_is_one_request(module):
    module.set(AxisParameter.TARGET_POSITION, -5000)
    drive = drive_of(module)
    drive.start_move(0.005)
    module.requests.clear()
    drive.stop()
    assert [asked.command for asked in module.requests] == [Command.MST]


@pytest.mark.parametrize("is_heard", [False, True])
def test_a_stop_of_a_search_halts_first_and_ends_the_search_whether_heard_or_not(module, is_heard):
    link = TmclLink(LoopbackTransport("loopback://m", module.receive), LineSettings())
    drive = drive_of(module, link=link)
    drive.start_homing()
    module.requests.clear()
    module.is_heard = is_heard
    link.hurry(0.03)
    with nullcontext() if is_heard else pytest.raises(CommunicationError):
        drive.stop()
    sent = [(asked.command, asked.type) for asked in module.requests]
    assert sent[:2] == [(Command.MST, 0), (Command.RFS, tmcl.ReferenceSearch.STOP)]


def test_while_it_moves_a_drive_is_asked_three_things(module):
    module.set(AxisParameter.TARGET_POSITION, -5000)
    drive = drive_of(module)
    assert drive.state().is_homed
    drive.start_move(0.005)
    module.set(AxisParameter.POSITION_REACHED, 0)
    module.set(AxisParameter.ACTUAL_SPEED, 900)
    module.requests.clear()
    assert drive.state().is_moving
    assert len(module.requests) == 3
    # it was reset in mid-move: it stands, and does not know where
    module.set(AxisParameter.POSITION_REACHED, 1)
    module.set(AxisParameter.ACTUAL_SPEED, 0)
    module.values[Command.GGP, HOMED_VARIABLE + MOTOR, tmcl.USER_BANK] = 0
    assert not drive.state().is_homed
