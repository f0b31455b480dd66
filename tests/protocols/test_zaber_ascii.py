r"""Zaber ASCII lines: a table used both ways, and any bytes at all."""

from __future__ import annotations

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocols import zaber_ascii as zaber
from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError
from firmware_protocols.zaber_ascii import Alert, AnswerParser, Command, CommandParser, Info, Reply, Status

# `/1 0 00 get pos:2D` and `@01 0 00 OK IDLE -- 1234` were seen on the wire of zaber-motion 10.2; the rest follows the
# ASCII Protocol Manual, "Message format".
TABLE = [
    (Command(1, 0, "get pos", 0), b"/1 0 00 get pos:2D\r\n"),
    (Command(0, 0, "home", None, False), b"/0 0 home\r\n"),
    (Command(4, 2, "move abs -12345", 7, False), b"/4 2 07 move abs -12345\r\n"),
    (Command(1, 0, "", None, False), b"/1 0\r\n"),
    (Reply(1, 0, True, Status.IDLE, "--", "1234", 0, False), b"@01 0 00 OK IDLE -- 1234\r\n"),
    (Reply(1, 1, True, Status.BUSY, "WR", "0", None, False), b"@01 1 OK BUSY WR 0\r\n"),
    (Reply(99, 9, False, Status.IDLE, "FS", "BADDATA", 99, False), b"@99 9 99 RJ IDLE FS BADDATA\r\n"),
    (Reply(1, 1, True, Status.IDLE, "WR", "02 WR WH", 5, False), b"@01 1 05 OK IDLE WR 02 WR WH\r\n"),
    (Info(1, 0, "Visit www.zaber.com! 5/6 @ #1", None, False), b"#01 0 Visit www.zaber.com! 5/6 @ #1\r\n"),
    (Alert(1, 1, Status.IDLE, "--", "", False), b"!01 1 IDLE --\r\n"),
]
IDS = [wire.decode().strip() for _, wire in TABLE]

PRINTABLE = "".join(sorted(set(string.ascii_letters + string.digits + string.punctuation) - {":"}))
WORD = st.text(string.ascii_lowercase + "._", min_size=1, max_size=8) | st.integers(-(10**9), 10**9).map(str)
WORDS = st.lists(WORD, max_size=4).map(lambda words: " ".join(["get", *words]))
DEVICE, AXIS = st.integers(0, 99), st.integers(0, 9)
ID = st.none() | st.integers(0, 99)
FLAG = st.sampled_from([*zaber.WARNING_WORDS, "--"])
STATUS = st.sampled_from(Status)
DATA = st.lists(st.text(PRINTABLE, min_size=1, max_size=6), min_size=1, max_size=4).map(" ".join)
ANY_COMMAND = st.builds(Command, DEVICE, AXIS, WORDS, ID, st.booleans())
ANY_ANSWER = (
    st.builds(Reply, DEVICE, AXIS, st.booleans(), STATUS, FLAG, DATA, ID, st.booleans())
    | st.builds(Info, DEVICE, AXIS, DATA.map("text {}".format), ID, st.booleans())
    | st.builds(Alert, DEVICE, AXIS, STATUS, FLAG, DATA | st.just(""), st.booleans())
)


def parser_for(message):
    return CommandParser() if isinstance(message, Command) else AnswerParser()


def everything(parser):
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


@pytest.mark.parametrize(("message", "wire"), TABLE, ids=IDS)
def test_both_ways(message, wire):
    assert message.encode() == wire
    parser = parser_for(message)
    parser.receive_data(wire)
    assert everything(parser) == ([message], 0)


@pytest.mark.parametrize(("message", "wire"), TABLE, ids=IDS)
def test_byte_by_byte(message, wire):
    parser = parser_for(message)
    for byte in wire[:-1]:
        parser.receive_data(bytes([byte]))
        assert parser.next_message() is None
    parser.receive_data(wire[-1:])
    assert parser.next_message() == message
    assert parser.n_skipped == 0


@pytest.mark.parametrize("garbage", [b"\x00", b"\xff\xfe", b"noise", b"@01 0 OK ID", b"/1 0 get p", b"!!", b"@/#"])
@pytest.mark.parametrize(("message", "wire"), TABLE, ids=IDS)
def test_found_behind_garbage_and_cut_off_messages(message, wire, garbage):
    parser = parser_for(message)
    parser.receive_data(garbage + wire)
    messages, n_errors = everything(parser)
    assert messages == [message]
    assert n_errors == 1
    assert parser.n_skipped == len(garbage)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # the manual's short forms: device and axis may be missing, spaces are free, LF alone ends a line
        (b"/\n", Command(0, 0, "", None, False)),
        (b"/get pos\n", Command(0, 0, "get pos", None, False)),
        (b"/2 stop\r\n", Command(2, 0, "stop", None, False)),
        (b"/02  1   move abs  5\n", Command(2, 1, "move abs 5", None, False)),
        (b"/1 2 3 get pos\n", Command(1, 2, "get pos", 3, False)),
    ],
)
def test_short_forms_of_commands(line, message):
    parser = CommandParser()
    parser.receive_data(line)
    assert parser.next_message() == message


@pytest.mark.parametrize(
    "line",
    [
        b"@01 0 00 OK IDLE -- 1234:00",
        b"@01 0 00 OK IDLE -- 1234:+3",
        b"@01 0 00 OK IDLE -- 1234:",
        b"@01 0 00 OK IDLE -- 1234:7",
        b"@01 0 00 OK IDLE --",
        b"@01 0 00 KO IDLE -- 0",
        b"@01 0 00 OK LAZY -- 0",
        b"@01 0 00 OK IDLE wr 0",
        b"@1 17 OK IDLE -- 0",
        b"@001 0 OK IDLE -- 0",
        b"@",
        b"!01 1",
        b"hello",
        b"@01 0 00 OK IDLE -- 12\x9934",
        b"x" * 80,
    ],
)
def test_refused(line):
    parser = AnswerParser()
    parser.receive_data(line + b"\n")
    assert everything(parser) == ([], 1)
    assert parser.n_skipped == len(line)


@given(message=ANY_COMMAND | ANY_ANSWER)
def test_round_trip(message):
    parser = parser_for(message)
    parser.receive_data(message.encode())
    assert everything(parser) == ([message], 0)


@given(message=ANY_COMMAND | ANY_ANSWER, bit=st.integers(min_value=8))
def test_every_wrong_bit_of_a_message_with_checksum_is_found(message, bit):
    """Damage may also hide the colon, or cut the line: then no checksum is seen, and who insists on one is safe."""
    line = bytearray(message.encode())
    bit = 8 + (bit - 8) % (8 * (len(line) - 3))
    line[bit // 8] ^= 1 << bit % 8
    parser = parser_for(message)
    parser.receive_data(bytes(line))
    for found in everything(parser)[0]:
        # a wrong bit may make a small letter of a hexadecimal digit, which is the same number
        assert not found.has_checksum or found == message


@pytest.mark.parametrize("bit", range(8))
@given(message=ANY_COMMAND | ANY_ANSWER)
def test_a_wrong_bit_in_the_first_character_makes_no_reply_of_anything_else(message, bit):
    """Zaber's checksum leaves the first character out: one bit makes an info of an alert, but never an answer."""
    line = bytearray(message.encode())
    line[0] ^= 1 << bit
    parser = parser_for(message)
    parser.receive_data(bytes(line))
    assert not any(isinstance(found, Command | Reply) for found in everything(parser)[0])


@given(messages=st.lists(ANY_ANSWER, max_size=5), data=st.data())
def test_however_the_stream_is_cut(messages, data):
    stream = b"".join(message.encode() for message in messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    parser = AnswerParser()
    seen = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        parser.receive_data(stream[start:end])
        found, n_errors = everything(parser)
        assert n_errors == 0
        seen += found
    assert seen == messages


SOUP = st.binary(max_size=60) | st.text("/@#! :-0123456789OKRJIDLEBUSYW\r\n", max_size=60).map(str.encode)


@given(chunks=st.lists(SOUP))
def test_byte_soup(chunks):
    """Anything parses or raises RemoteProtocolError; a good message after it is found."""
    for parser, message in ((CommandParser(), TABLE[0][0]), (AnswerParser(), TABLE[4][0])):
        for chunk in chunks:
            parser.receive_data(chunk)
            everything(parser)
        parser.receive_data(b"\n" + message.encode())
        assert everything(parser)[0][-1] == message


def test_a_line_without_end_is_given_up():
    parser = AnswerParser()
    parser.receive_data(b"@" * (zaber.MAX_LINE_LENGTH + 1))
    with pytest.raises(RemoteProtocolError, match="without a line end"):
        parser.next_message()
    assert parser.n_skipped == zaber.MAX_LINE_LENGTH + 1
    parser.receive_data(b"\n@01 0 00 OK IDLE -- 1234\r\n")
    assert parser.next_message() == TABLE[4][0]


@pytest.mark.parametrize(
    "message",
    [
        Command(100, 0, "home"),
        Command(1, 10, "home"),
        Command(1, 1, "home", 100),
        Command(1, 1, "get pos:2D"),
        Command(1, 1, "move\nabs"),
        Reply(1, 1, True, Status.IDLE, "w!"),
        Reply(1, 1, True, Status.IDLE, data=" "),
        Alert(1, 1, Status.IDLE, "-"),
        Info(1, 1, "5 µm"),
    ],
)
def test_what_the_protocol_can_not_say_is_our_fault(message):
    with pytest.raises(LocalProtocolError):
        message.encode()


def test_words():
    assert zaber.warning_words("WR") == "no reference position"
    assert zaber.warning_words("XY") == "unknown warning XY"
    assert zaber.rejection_words("BADDATA") == "value out of range"
    assert zaber.rejection_words("WHY") == "rejected with WHY"
