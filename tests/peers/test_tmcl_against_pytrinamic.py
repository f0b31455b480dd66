"""TMCL beside pytrinamic, Trinamic's own package: the same frames, and each side's master against the other's codec."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocols import tmcl
from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.devices.links import LineSettings, TmclLink
from namod_ctl.devices.transports import LoopbackTransport

pytest.importorskip("pytrinamic", reason="pytrinamic is not installed (extra 'peers')")

from pytrinamic import tmcl as theirs
from pytrinamic.connections.serial_tmcl_interface import SerialTmclInterface
from pytrinamic.modules.TMCM6110 import TMCM6110

BYTE = st.integers(0, 255)
VALUE = st.integers(tmcl.VALUE_MIN, tmcl.VALUE_MAX)
MODULE, MOTOR = 3, 4


@given(head=st.tuples(BYTE, BYTE, BYTE, BYTE), value=VALUE)
def test_the_same_requests(head, value):
    frame = tmcl.Request(*head, value).encode()
    assert frame == theirs.TMCLRequest(*head, value).to_buffer()
    read = theirs.TMCLRequest.from_buffer(frame)
    assert (read.moduleAddress, read.command, read.commandType, read.motorBank) == head
    assert read.value == value % 2**32


@given(head=st.tuples(BYTE, BYTE, BYTE, BYTE), value=VALUE)
def test_the_same_replies(head, value):
    frame = tmcl.Reply(*head, value).encode()
    assert frame == theirs.TMCLReply(*head, value).to_buffer()
    assert theirs.TMCLReply.from_buffer(frame).is_checksum_correct()
    assert tmcl.Reply.decode(theirs.TMCLReply(*head, value).to_buffer()) == tmcl.Reply(*head, value)


def test_the_same_words():
    for command in tmcl.Command:
        assert theirs.TMCLCommand.get_name(command.value) == command.name
    for status in (1, 2, 3, 4, 6):
        assert theirs.TMCLStatus.get_name(status).lower().split()[-1] == tmcl.status_words(status).split()[-1]
    names = {
        tmcl.AxisParameter.TARGET_POSITION: "TargetPosition",
        tmcl.AxisParameter.ACTUAL_POSITION: "ActualPosition",
        tmcl.AxisParameter.ACTUAL_SPEED: "ActualVelocity",
        tmcl.AxisParameter.MAX_SPEED: "MaxVelocity",
        tmcl.AxisParameter.MAX_ACCELERATION: "MaxAcceleration",
        tmcl.AxisParameter.POSITION_REACHED: "PositionReachedFlag",
        tmcl.AxisParameter.RIGHT_LIMIT_SWITCH: "RightEndstop",
        tmcl.AxisParameter.LEFT_LIMIT_SWITCH: "LeftEndstop",
        tmcl.AxisParameter.REFERENCE_SEARCH_MODE: "ReferenceSearchMode",
        tmcl.AxisParameter.REFERENCE_SEARCH_SPEED: "ReferenceSearchSpeed",
        tmcl.AxisParameter.REFERENCE_SWITCH_SPEED: "ReferenceSwitchSpeed",
        tmcl.AxisParameter.EXTENDED_ERROR_FLAGS: "ExtendedErrorFlags",
        tmcl.AxisParameter.DRIVER_ERROR_FLAGS: "DrvStatusFlags",
    }
    for parameter, name in names.items():
        assert getattr(TMCM6110._MotorTypeA.AP, name) == parameter


class Register:
    """What is behind either side's codec here: parameters that keep what was written."""

    def __init__(self) -> None:
        self._values: dict[tuple[int, int], int] = {}

    def carry_out(self, command: int, type_: int, motor: int, value: int) -> int:
        if command in (tmcl.Command.SAP, tmcl.Command.SGP):
            self._values[type_, motor] = value
        elif command == tmcl.Command.MVP:
            self._values[0, motor] = self._values[1, motor] = value
        elif command in (tmcl.Command.GAP, tmcl.Command.GGP):
            return self._values.get((type_, motor), 0)
        return value


@pytest.fixture
def port() -> Iterator[str]:
    """A serial port behind which our codec plays the module."""
    near, far = os.openpty()
    tty.setraw(near)
    tty.setraw(far)

    def serve() -> None:
        parser, register = tmcl.RequestParser([MODULE]), Register()
        while True:
            try:
                parser.receive_data(os.read(near, 64))
            except OSError:
                return
            try:
                while (request := parser.next_message()) is not None:
                    status = tmcl.Status.OK if request.command in set(tmcl.Command) else tmcl.Status.INVALID_COMMAND
                    value = register.carry_out(request.command, request.type, request.motor, request.value)
                    os.write(near, tmcl.Reply(2, request.module, status, request.command, value).encode())
            except RemoteProtocolError:
                os.write(near, tmcl.Reply(2, MODULE, tmcl.Status.WRONG_CHECKSUM, 0).encode())

    server = threading.Thread(target=serve)
    server.start()
    try:
        yield os.ttyname(far)
    finally:
        os.close(far)
        # the last slave is closed: the server's read ends with an error
        server.join(5.0)
        os.close(near)


def test_their_master_understands_our_replies(port):
    master = SerialTmclInterface(port, datarate=9600, module_id=MODULE, timeout_s=5)
    try:
        module = TMCM6110(master, module_id=MODULE)
        module.move_to(MOTOR, -51200)
        assert module.motors[MOTOR].actual_position == -51200
        master.set_axis_parameter(tmcl.AxisParameter.MAX_SPEED, MOTOR, 1000)
        assert master.get_axis_parameter(tmcl.AxisParameter.MAX_SPEED, MOTOR) == 1000
        master.set_global_parameter(64, tmcl.USER_BANK, 1)
        assert master.get_global_parameter(64, tmcl.USER_BANK) == 1
        module.stop(MOTOR)
        with pytest.raises(theirs.TMCLReplyStatusError) as refused:
            master.send(200, 0, 0, 0)
        assert refused.value.error_description == "Invalid Command"
        # a request with a wrong sum
        broken = theirs.TMCLRequest(MODULE, tmcl.Command.MST, 0, 0, 0, checksum=99)
        with pytest.raises(theirs.TMCLReplyStatusError) as refused:
            master.send_request(broken)
        assert refused.value.status_code == tmcl.Status.WRONG_CHECKSUM
    finally:
        master.close()


def test_our_link_understands_their_replies():
    register = Register()

    def module(data: bytes) -> bytes:
        asked = theirs.TMCLRequest.from_buffer(data)
        value = register.carry_out(asked.command, asked.commandType, asked.motorBank, asked.value)
        return theirs.TMCLReply(2, asked.moduleAddress, theirs.TMCLStatus.SUCCESS, asked.command, value).to_buffer()

    link = TmclLink(LoopbackTransport("loopback://module", module), LineSettings())
    for position in (-51200, 0, 2**31 - 1, -(2**31)):
        link.exchange(tmcl.Request(MODULE, tmcl.Command.MVP, tmcl.MoveType.ABS, MOTOR, position))
        asked = tmcl.Request(MODULE, tmcl.Command.GAP, tmcl.AxisParameter.ACTUAL_POSITION, MOTOR)
        assert link.exchange(asked).value == position
    assert link.statistics.n_retries == 0
