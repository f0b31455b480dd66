"""TMCL frames: a table used both ways, and any bytes at all."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocols import tmcl
from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError
from firmware_protocols.tmcl import Command, Reply, Request, Status

# The first three rows are examples of the TMCM-6110 TMCL firmware manual (ROR, MST, MVP), the fourth is pytrinamic's.
REQUESTS = [
    (Request(1, Command.ROR, 0, 0, 350), "01 01 00 00 00 00 01 5e 61"),
    (Request(1, Command.MST, 0, 1, 0), "01 03 00 01 00 00 00 00 05"),
    (Request(1, Command.MVP, tmcl.MoveType.ABS, 1, 90000), "01 04 00 01 00 01 5f 90 f6"),
    (Request(1, Command.MVP, tmcl.MoveType.ABS, 2, -51200), "01 04 00 02 ff ff 38 00 3d"),
    (Request(7, Command.GAP, tmcl.AxisParameter.ACTUAL_POSITION, 5, 0), "07 06 01 05 00 00 00 00 13"),
    (Request(255, 255, 255, 255, -1), "ff ff ff ff ff ff ff ff f8"),
    (Request(1, Command.GGP, 64, tmcl.USER_BANK, tmcl.VALUE_MIN), "01 0a 40 02 80 00 00 00 cd"),
]
REPLIES = [
    (Reply(2, 1, Status.OK, Command.ROR, 350), "02 01 64 01 00 00 01 5e c7"),
    (Reply(2, 1, Status.OK, Command.GAP, 711), "02 01 64 06 00 00 02 c7 36"),
    (Reply(2, 3, Status.WRONG_CHECKSUM, Command.MVP, 0), "02 03 01 04 00 00 00 00 0a"),
    (Reply(2, 1, Status.OK, Command.GAP, -1), "02 01 64 06 ff ff ff ff 69"),
]
TABLE = [*REQUESTS, *REPLIES]

BYTE = st.integers(0, 255)
VALUE = st.integers(tmcl.VALUE_MIN, tmcl.VALUE_MAX)
ANY_REQUEST = st.builds(Request, BYTE, BYTE, BYTE, BYTE, VALUE)
ANY_REPLY = st.builds(Reply, BYTE, BYTE, BYTE, BYTE, VALUE)


def parser_for(message):
    return tmcl.RequestParser(range(1, 8)) if isinstance(message, Request) else tmcl.ReplyParser(2)


def everything(parser):
    """All messages a parser has, and how often it raised on the way."""
    messages, n_errors = [], 0
    while True:
        try:
            message = parser.next_message()
        except RemoteProtocolError:
            n_errors += 1
            continue
        if message is None:
            return messages, n_errors
        messages.append(message)


@pytest.mark.parametrize(("message", "wire"), TABLE)
def test_both_ways(message, wire):
    frame = bytes.fromhex(wire)
    assert message.encode() == frame
    assert type(message).decode(frame) == message


@pytest.mark.parametrize(("message", "wire"), TABLE)
def test_byte_by_byte(message, wire):
    frame = bytes.fromhex(wire)
    parser = parser_for(message)
    for byte in frame[:-1]:
        parser.receive_data(bytes([byte]))
        assert parser.next_message() is None
    parser.receive_data(frame[-1:])
    assert parser.next_message() == message
    assert parser.next_message() is None
    assert parser.n_skipped == 0


@pytest.mark.parametrize(("message", "wire"), [row for row in TABLE if row[0] != Request(255, 255, 255, 255, -1)])
@pytest.mark.parametrize("garbage", [b"\x00", b"\xff" * 5, b"noise", bytes(range(20, 40))])
def test_found_behind_garbage(message, wire, garbage):
    parser = parser_for(message)
    # whatever noise and the frame make together, the frame after it is one that can be in the table only
    parser.receive_data(garbage + bytes.fromhex(wire) * 2)
    messages, n_errors = everything(parser)
    assert messages[-1] == message
    assert n_errors >= 1
    assert parser.n_skipped >= len(garbage)


def test_one_error_per_damaged_stretch():
    good = bytes.fromhex(REPLIES[0][1])
    bad = good[:4] + b"\x55" + good[5:]
    parser = tmcl.ReplyParser(2)
    parser.receive_data(good + bad + good + bad)
    messages, n_errors = everything(parser)
    assert messages == [REPLIES[0][0]] * 2
    assert n_errors == 2
    assert parser.n_skipped == 9 + 1
    assert parser.reset() == 8


def test_reset_begins_a_frame():
    message, wire = REQUESTS[3]
    parser = parser_for(message)
    parser.receive_data(b"\x01\x04\x00")
    assert parser.next_message() is None
    assert parser.reset() == 3
    parser.receive_data(bytes.fromhex(wire))
    assert parser.next_message() == message


def test_a_lost_byte_costs_one_frame_only():
    first, second = bytes.fromhex(REQUESTS[2][1]), bytes.fromhex(REQUESTS[3][1])
    parser = tmcl.RequestParser([1])
    parser.receive_data(first[:5] + first[6:] + second)
    assert everything(parser) == ([REQUESTS[3][0]], 1)


@given(message=ANY_REQUEST | ANY_REPLY, bit=st.integers(0, 71))
def test_every_wrong_bit_is_found(message, bit):
    frame = bytearray(message.encode())
    frame[bit // 8] ^= 1 << bit % 8
    with pytest.raises(RemoteProtocolError, match="sum"):
        type(message).decode(bytes(frame))


@given(message=ANY_REQUEST | ANY_REPLY)
def test_round_trip(message):
    assert type(message).decode(message.encode()) == message


@given(messages=st.lists(ANY_REPLY), data=st.data())
def test_however_the_stream_is_cut(messages, data):
    stream = b"".join(message.encode() for message in messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    parser = tmcl.ReplyParser(2)
    seen = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        parser.receive_data(stream[start:end])
        found, n_errors = everything(parser)
        assert n_errors == 0
        seen += found
    assert seen == messages


@given(chunks=st.lists(st.binary(max_size=40)))
def test_byte_soup(chunks):
    """Anything parses or raises RemoteProtocolError, and no byte is counted twice or lost."""
    for parser in (tmcl.RequestParser([1, 2]), tmcl.ReplyParser(2)):
        n_messages = 0
        for chunk in chunks:
            parser.receive_data(chunk)
            n_messages += len(everything(parser)[0])
        parser.reset()
        assert 9 * n_messages + parser.n_skipped == sum(map(len, chunks))


@given(soup=st.binary(max_size=20))
def test_decode_of_soup(soup):
    for kind in (Request, Reply):
        try:
            message = kind.decode(soup)
        except RemoteProtocolError:
            continue
        assert message.encode() == soup


@pytest.mark.parametrize(
    "message",
    [
        Request(256, Command.MST),
        Request(-1, Command.MST),
        Request(1, Command.MVP, 300),
        Request(1, Command.MVP, value=2**31),
        Reply(2, 1, 100, 400),
        Reply(2, 1, 100, 4, -(2**31) - 1),
    ],
)
def test_what_does_not_fit_is_our_fault(message):
    with pytest.raises(LocalProtocolError):
        message.encode()


def test_words():
    assert tmcl.status_words(Status.INVALID_VALUE) == "invalid value"
    assert tmcl.status_words(77) == "unknown status 77"
    # TMCM-6110 manual, command 136: 0x17DE is 6110
    assert tmcl.firmware_text(0x17DE0115) == "TMCM-6110 firmware 1.21"
    assert tmcl.firmware_value(6110, 1, 21) == 0x17DE0115


@given(model=st.integers(0, 65535), major=st.integers(0, 255), minor=st.integers(0, 99))
def test_firmware_round_trip(model, major, minor):
    value = Reply.decode(Reply(2, 1, 100, 136, tmcl.firmware_value(model, major, minor)).encode()).value
    assert tmcl.firmware_text(value) == f"TMCM-{model} firmware {major}.{minor:02d}"
