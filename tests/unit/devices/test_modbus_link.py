"""Modbus links: no answer is ever taken for another register's, damage is survived, refusals come in words."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

from modbus_bus import UNITS, Bus, word_at
from virtual_lines import VirtualLine

from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.links import LineSettings
from namod_ctl.devices.modbus_link import Framing, ModbusLink, RtuParser, TcpParser
from namod_ctl.devices.transports import LoopbackTransport

SETTINGS = LineSettings(timeout_s=0.1, n_retries=3)
# worked examples of requests and answers: MODBUS Application Protocol V1.1b3, section 6.3 (registers 108 to 110 hold
# 555, 0, 100), with the unit and check sum of a serial line around it (check sums by the algorithm of its appendix B)
RTU_ANSWER = bytes.fromhex("11 03 06 022B 0000 0064 C8BA")
TCP_ANSWER = bytes.fromhex("0001 0000 0009 11 03 06 022B 0000 0064")


def loopback(framing: Framing, **settings_: float) -> tuple[ModbusLink, Bus]:
    bus = Bus(framing)
    transport = LoopbackTransport("loopback://modbus", bus.receive)
    return ModbusLink(transport, LineSettings(**settings_), framing), bus  # type: ignore[arg-type]


@pytest.mark.parametrize("framing", Framing)
def test_reads_and_writes(framing: Framing) -> None:
    link, bus = loopback(framing)
    assert link.read(2, 3, 40, 3) == tuple(word_at(2, 3, at) for at in (40, 41, 42))
    assert link.read(1, 4, 7, 1) == (word_at(1, 4, 7),)
    link.write(3, 6, 9, [0xBEEF])
    link.write(3, 16, 9, [1, 2])
    assert bus.units[3].written == [(6, 9, (0xBEEF,)), (16, 9, (1, 2))]
    assert link.statistics.n_exchanges == 4
    assert link.statistics.n_retries == 0


CHANCE = st.sampled_from([0.0, 0.05, 0.3])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    late=CHANCE,
    lost=CHANCE,
    questions=st.lists(
        st.tuples(st.sampled_from(UNITS), st.sampled_from([3, 4]), st.integers(0, 50), st.integers(1, 3)),
        min_size=1,
        max_size=25,
    ),
)
@pytest.mark.parametrize("framing", Framing)
def test_no_answer_is_taken_for_that_to_another_question(framing, seed, late, lost, questions):
    link = ModbusLink(VirtualLine(Bus(framing, seed, late, lost).peer), SETTINGS, framing)
    for unit, function, address, count in questions:
        try:
            words = link.read(unit, function, address, count)
        except CommunicationError:
            continue
        assert words == tuple(word_at(unit, function, at) for at in range(address, address + count))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), late=CHANCE, damaged=CHANCE, addresses=st.lists(st.integers(0, 50), max_size=20))
def test_a_check_sum_keeps_damage_out(seed: int, late: float, damaged: float, addresses: list[int]) -> None:
    link = ModbusLink(VirtualLine(Bus(Framing.RTU, seed, late, 0.0, damaged).peer), SETTINGS, Framing.RTU)
    for address in addresses:
        try:
            assert link.read(1, 3, address, 2) == (word_at(1, 3, address), word_at(1, 3, address + 1))
        except CommunicationError:
            continue


def test_a_unit_that_is_always_too_late_is_never_misread() -> None:
    bus = Bus(Framing.RTU)
    link = ModbusLink(VirtualLine(lambda data: [(0.15, bus.receive(data))]), SETTINGS, Framing.RTU)
    for address in range(0, 60, 10):
        try:
            words = link.read(1, 3, address, 2)
        except CommunicationError:
            continue
        assert words == (word_at(1, 3, address), word_at(1, 3, address + 1))


def test_a_write_is_not_confirmed_by_the_late_answer_to_another() -> None:
    """Function 16 confirms address and count, not the words: a lost order must not be believed."""
    bus = Bus(Framing.RTU)
    fates: list[Callable[[bytes], list[tuple[float, bytes]]]] = [lambda data: [(0.35, bus.receive(data))]]
    fates += [lambda data: []] * 3  # the first order is done late, its repetitions and the second order are lost
    line = VirtualLine(lambda data: fates.pop(0)(data) if fates else [])
    link = ModbusLink(line, LineSettings(timeout_s=0.1, n_retries=2), Framing.RTU)
    with pytest.raises(CommunicationError):
        link.write(1, 16, 5, [0, 1])
    with pytest.raises(CommunicationError):
        link.write(1, 16, 5, [0, 2])
    assert bus.units[1].written == [(16, 5, (0, 1))]


@pytest.mark.parametrize("framing", Framing)
def test_garbage_before_and_a_stream_byte_by_byte(framing: Framing) -> None:
    bus = Bus(framing)

    def peer(data: bytes) -> list[tuple[float, bytes]]:
        stream = b"\xff\x00\x37\x03" + bus.receive(data)
        return [(0.001, stream[i : i + 1]) for i in range(len(stream))]

    link = ModbusLink(VirtualLine(peer), SETTINGS, framing)
    assert link.read(1, 3, 20, 2) == (word_at(1, 3, 20), word_at(1, 3, 21))
    assert link.statistics.n_garbage_bytes == 4
    assert link.statistics.n_retries == 0


def test_an_echo_is_taken_away() -> None:
    """A write of one register is confirmed by its own bytes: an echo that is believed would hide a dead drive."""
    bus = Bus(Framing.RTU)
    with_echo = LineSettings(timeout_s=0.01, n_retries=1, has_echo=True)
    link = ModbusLink(LoopbackTransport("echo", lambda data: data + bus.receive(data)), with_echo, Framing.RTU)
    link.write(1, 6, 3, [77])
    assert link.read(1, 3, 0, 4) == tuple(word_at(1, 3, at) for at in range(4))
    dead = ModbusLink(LoopbackTransport("echo", lambda data: data), with_echo, Framing.RTU)
    with pytest.raises(CommunicationError):
        dead.write(1, 6, 3, [77])


def test_the_line_rests_before_a_question() -> None:
    line = VirtualLine(Bus(Framing.RTU).peer)
    link = ModbusLink(line, LineSettings(turnaround_s=0.02), Framing.RTU)
    for _ in range(4):
        link.read(1, 3, 0, 1)
    moments_s = [moment_s for moment_s, _ in line.written]
    # a waiting thread may be woken some microseconds early
    assert all(later - sooner >= 0.0195 for sooner, later in pairwise(moments_s))


@pytest.mark.parametrize("framing", Framing)
def test_a_refusal_comes_in_words(framing: Framing) -> None:
    link, _ = loopback(framing)
    with pytest.raises(DeviceFaultError, match=r"unit 2 on loopback://modbus.*register 200: it has no such register"):
        link.write(2, 16, 200, [1, 2])


def test_a_busy_unit_is_asked_again() -> None:
    link, bus = loopback(Framing.RTU)
    bus.units[1].n_busy = 2
    assert link.read(1, 3, 5, 1) == (word_at(1, 3, 5),)
    bus.units[1].n_busy = 1000
    with pytest.raises(DeviceFaultError, match="it is busy"):
        link.read(1, 3, 5, 1)


def test_a_gateway_that_reaches_nobody_is_no_fault_of_the_drive() -> None:
    link, _ = loopback(Framing.TCP)
    with pytest.raises(CommunicationError, match=r"unit 9 .*does not answer its gateway"):
        link.read(9, 3, 0, 1)


def test_a_plug_pulled_and_put_back() -> None:
    line = VirtualLine(Bus(Framing.RTU).peer)
    link = ModbusLink(line, SETTINGS, Framing.RTU)
    line.is_plugged = False
    with pytest.raises(CommunicationError, match="unplugged"):
        link.read(1, 3, 0, 1)
    line.is_plugged = True
    assert link.read(1, 3, 0, 1) == (word_at(1, 3, 0),)


@pytest.mark.parametrize(("parser", "answer"), [(RtuParser(), RTU_ANSWER), (TcpParser(), TCP_ANSWER)])
def test_published_answers(parser: RtuParser | TcpParser, answer: bytes) -> None:
    parser.receive_data(answer)
    message = parser.next_message()
    assert message is not None
    assert (message.dev_id, message.registers) == (0x11, [555, 0, 100])


@pytest.mark.parametrize("kind", [RtuParser, TcpParser])
@given(pieces=st.lists(st.binary(max_size=40) | st.sampled_from([RTU_ANSWER, TCP_ANSWER, b"\0" * 9]), max_size=8))
def test_byte_soup_is_read_or_is_the_peers_fault(kind: type[RtuParser | TcpParser], pieces: list[bytes]) -> None:
    parser = kind()
    for piece in pieces:
        parser.receive_data(piece)
        for _ in range(sum(map(len, pieces)) + 2):
            try:
                if parser.next_message() is None:
                    break
            except RemoteProtocolError:
                continue
        else:
            raise AssertionError("the parser never ends")


@given(garbage=st.binary(max_size=30), cuts=st.lists(st.integers(0, 40), max_size=3))
def test_an_rtu_answer_is_found_behind_any_garbage(garbage: bytes, cuts: list[int]) -> None:
    parser = RtuParser()
    stream = garbage + RTU_ANSWER
    found = []
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    for first, last in pairwise(edges):
        parser.receive_data(stream[first:last])
        for _ in range(len(stream) + 2):
            try:
                message = parser.next_message()
            except RemoteProtocolError:
                continue
            if message is None:
                break
            found.append(message.registers)
    assert found[-1:] == [[555, 0, 100]]


@pytest.mark.parametrize("framing", Framing)
def test_an_exchange_adds_less_than_a_millisecond(framing: Framing) -> None:
    link, _ = loopback(framing)
    times_s = []
    for _ in range(50):
        begin_s = time.process_time()
        link.read(1, 3, 0, 2)
        times_s.append(time.process_time() - begin_s)
    assert sorted(times_s)[25] < 0.001


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    late=CHANCE,
    lost=CHANCE,
    questions=st.lists(
        st.tuples(
            st.sampled_from(UNITS), st.sampled_from([3, 4]), st.integers(0, 50), st.integers(1, 3), st.booleans()
        ),
        min_size=1,
        max_size=25,
    ),
)
@pytest.mark.parametrize("framing", Framing)
def test_no_answer_is_taken_for_another_in_a_hurry_either(framing, seed, late, lost, questions):
    link = ModbusLink(VirtualLine(Bus(framing, seed, late, lost).peer), SETTINGS, framing)
    for unit, function, address, count, is_hurried in questions:
        link.hurry(0.03 if is_hurried else None)
        try:
            words = link.read(unit, function, address, count)
        except CommunicationError:
            continue
        assert words == tuple(word_at(unit, function, at) for at in range(address, address + count))


def test_a_unit_out_of_step_hears_its_stop_in_a_hurry_and_confirms_it_afterwards() -> None:
    bus = Bus(Framing.RTU)
    is_heard = False
    line = VirtualLine(lambda data: bus.peer(data) if is_heard else [])
    link = ModbusLink(line, SETTINGS, Framing.RTU)
    with pytest.raises(CommunicationError):
        link.read(1, 3, 0, 1)
    is_heard = True
    link.hurry(0.03)
    with pytest.raises(CommunicationError, match="told in a hurry"):
        link.write(1, 6, 9, [2])
    assert bus.units[1].written == [(6, 9, (2,))]
    link.hurry(None)
    link.write(1, 6, 9, [2])
    assert bus.units[1].written == [(6, 9, (2,))] * 2
