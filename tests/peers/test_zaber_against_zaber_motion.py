"""Zaber ASCII beside zaber-motion, Zaber's own master: what it sends is understood, what we answer is accepted."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from firmware_protocols import zaber_ascii as zaber
from firmware_protocols.errors import RemoteProtocolError

pytest.importorskip("zaber_motion", reason="zaber-motion is not installed (extra 'peers')")

from zaber_motion import CommandFailedException, MotionLibException, RequestTimeoutException
from zaber_motion.ascii import Connection, Transport, WarningFlags


class Device:
    """The far end of zaber-motion's line: `answer` gives what comes back for each command."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.commands: list[zaber.Command] = []
        self.answer: Callable[[zaber.Command], bytes] = ok
        self.transport = Transport.open()
        self._parser = zaber.CommandParser()

    def serve(self) -> None:
        """Answer until the line is closed."""
        while True:
            try:
                line = self.transport.read()
            except MotionLibException:
                return
            self.lines.append(line)
            self._parser.receive_data(line.encode() + b"\n")
            command = self._parser.next_message()
            assert command is not None
            self.commands.append(command)
            for answer in self.answer(command).decode().splitlines():
                self.transport.write(answer)


def ok(command: zaber.Command) -> bytes:
    return reply(command).encode()


def reply(command: zaber.Command, **changes: object) -> zaber.Reply:
    fields: dict[str, object] = {
        "device": command.device,
        "axis": command.axis,
        "is_ok": True,
        "status": zaber.Status.IDLE,
        "message_id": command.message_id,
        "has_checksum": command.has_checksum,
    }
    return zaber.Reply(**(fields | changes))


@pytest.fixture
def device() -> Iterator[Device]:
    device = Device()
    server = threading.Thread(target=device.serve)
    server.start()
    try:
        yield device
    finally:
        device.transport.close()
        server.join(5.0)


@pytest.fixture
def master(device: Device) -> Iterator[Connection]:
    connection = Connection.open_custom(device.transport)
    try:
        yield connection
    finally:
        connection.close()


@pytest.mark.parametrize("has_checksum", [True, False])
@pytest.mark.parametrize(
    ("words", "address", "axis"), [("get pos", 1, 0), ("move abs -12345", 9, 4), ("home", 99, 1), ("", 2, 0)]
)
def test_what_it_sends_is_what_we_send(device, master, words, address, axis, has_checksum):
    master.checksum_enabled = has_checksum
    master.generic_command(words, device=address, axis=axis)
    command = device.commands[-1]
    assert (command.device, command.axis, command.words) == (address, axis, words)
    assert command.has_checksum is has_checksum
    # it pads nothing and numbers its messages: byte for byte what our side encodes
    assert command.encode().decode().strip() == device.lines[-1]


def test_what_we_answer_is_what_it_reads(device, master):
    for status in zaber.Status:
        for flag in ("--", "WR", "FS"):
            device.answer = lambda command, s=status, f=flag: reply(command, status=s, warning=f, data="-12 7").encode()
            read = master.generic_command("get pos", device=1, axis=2)
            assert (read.device_address, read.axis_number, read.reply_flag) == (1, 2, "OK")
            assert (read.status, read.warning_flag, read.data) == (status.value, flag, "-12 7")


def test_a_rejection(device, master):
    device.answer = lambda command: reply(command, is_ok=False, data="BADDATA").encode()
    with pytest.raises(CommandFailedException) as failed:
        master.generic_command("move abs 1", device=1, axis=1)
    assert failed.value.details.response_data == "BADDATA"


def test_alerts_and_infos_are_passed_over(device, master):
    device.answer = lambda command: (
        zaber.Alert(1, 1, zaber.Status.IDLE).encode()
        + reply(command, data="5").encode()
        + zaber.Info(1, 1, "text", command.message_id).encode()
    )
    assert master.generic_command("get pos", device=1, axis=1).data == "5"


def test_it_refuses_our_reply_with_a_wrong_checksum(device, master):
    """The checksum means something: with one digit changed on its way the reply does not count."""
    device.answer = lambda command: reply(command, data="1234").encode().replace(b"1234", b"1235")
    master.default_request_timeout = 100
    with pytest.raises(RequestTimeoutException):
        master.generic_command("get pos", device=1, axis=1)
    damaged = reply(device.commands[-1], data="1234").encode().replace(b"1234", b"1235")
    parser = zaber.AnswerParser()
    parser.receive_data(damaged)
    with pytest.raises(RemoteProtocolError, match="checksum"):
        parser.next_message()


def test_the_same_flags():
    """Flags that we know are flags that Zaber knows."""
    theirs = {value for name, value in vars(WarningFlags).items() if name.isupper()}
    assert set(zaber.WARNING_WORDS) <= theirs
    assert theirs >= zaber.UNHOMED_FLAGS | zaber.DRIVER_OFF_FLAGS
