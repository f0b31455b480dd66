"""Links: no answer is ever taken for another question's, and what is lost is asked for again."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

from virtual_lines import BadLuck, KnowingModules, VirtualLine, number_of

from firmware_protocols import tmcl
from firmware_protocols import zaber_ascii as zaber
from namod_ctl.core.errors import CommunicationError
from namod_ctl.devices.links import LineSettings, TmclLink, ZaberLink
from namod_ctl.devices.transports import LoopbackTransport

SETTINGS = LineSettings(timeout_s=0.1, n_retries=3)


def read(module: int, motor: int, type_: int = 1) -> tmcl.Request:
    return tmcl.Request(module, tmcl.Command.GAP, type_, motor)


CHANCE = st.sampled_from([0.0, 0.05, 0.3])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    late=CHANCE,
    lost=CHANCE,
    damaged=CHANCE,
    babbled=CHANCE,
    questions=st.lists(st.tuples(st.integers(1, 3), st.integers(0, 5), st.integers(0, 3)), min_size=1, max_size=25),
)
def test_no_reply_is_taken_for_that_to_another_question(seed, late, lost, damaged, babbled, questions):
    link = TmclLink(VirtualLine(BadLuck(seed, late, lost, damaged, babbled).peer), SETTINGS)
    for module, motor, type_ in questions:
        request = read(module, motor, type_)
        try:
            reply = link.exchange(request)
        except CommunicationError:
            continue
        assert reply.status == tmcl.Status.OK
        assert reply.value == number_of(request)


def test_a_module_that_is_always_too_late_is_never_misread():
    modules = KnowingModules()
    line = VirtualLine(lambda data: [(0.15, answer) for answer in modules.receive(data)])
    link = TmclLink(line, SETTINGS)
    for motor in range(6):
        with pytest.raises(CommunicationError, match="TMCL module 1 on virtual line"):
            link.exchange(read(1, motor))
    assert link.statistics.n_exchanges == 0


def test_a_reply_left_over_by_an_earlier_run_of_the_program():
    """The line still carries the position of motor 5, asked for by a program that was killed."""
    modules = KnowingModules()
    line = VirtualLine(lambda data: [(0.001, answer) for answer in modules.receive(data)], latency_s=0.01)
    line.write(read(1, 5).encode())
    assert TmclLink(line, SETTINGS).exchange(read(1, 0)).value == number_of(read(1, 0))


def test_an_exchange_that_was_broken_off_leaves_nothing_behind():
    modules = KnowingModules()

    def peer(data: bytes) -> list[tuple[float, bytes]]:
        return [(0.0, answer) for answer in modules.receive(data)]

    line = VirtualLine(peer, latency_s=0.01)
    link = TmclLink(line, SETTINGS)
    link.exchange(read(1, 0))
    pass_on = line.read
    line.read = lambda n_max, timeout_s: pass_on(n_max, timeout_s) if timeout_s == 0.0 else interrupt()
    with pytest.raises(KeyboardInterrupt):
        link.exchange(read(1, 1))
    line.read = pass_on
    assert link.exchange(read(1, 2)).value == number_of(read(1, 2))


def interrupt() -> bytes:
    raise KeyboardInterrupt


def test_statistics_and_a_damaged_request():
    modules = KnowingModules()
    script = iter([0, 0, 1, 0, 0, 0])

    def peer(data: bytes) -> list[tuple[float, bytes]]:
        damaged = data[:7] + bytes([data[7] ^ next(script)]) + data[8:]
        return [(0.0, answer) for answer in modules.receive(damaged)]

    link = TmclLink(VirtualLine(peer), SETTINGS)
    # the token's two, the damaged request, then the token and the request again
    assert link.exchange(read(1, 4)).value == number_of(read(1, 4))
    statistics = link.statistics
    assert (statistics.n_exchanges, statistics.n_retries, statistics.n_timeouts) == (1, 1, 0)


@pytest.mark.parametrize("cut", [0, 1, 5, 9])
def test_echo_is_taken_off(cut):
    modules = KnowingModules()

    def peer(data: bytes) -> list[tuple[float, bytes]]:
        answer = data + b"".join(modules.receive(data))
        return [(0.0, answer[:cut]), (0.001, answer[cut:])] if cut else [(0.0, answer)]

    link = TmclLink(VirtualLine(peer), LineSettings(has_echo=True))
    for motor in range(3):
        assert link.exchange(read(1, motor)).value == number_of(read(1, motor))
    assert link.statistics.n_retries == 0


def test_another_echo_means_a_collision():
    modules = KnowingModules()
    spoiled = iter([True])

    def peer(data: bytes) -> list[tuple[float, bytes]]:
        if next(spoiled, False):
            return [(0.0, b"\x00" + data[1:])]
        return [(0.0, data + b"".join(modules.receive(data)))]

    link = TmclLink(VirtualLine(peer), LineSettings(has_echo=True))
    assert link.exchange(read(2, 0)).value == number_of(read(2, 0))
    assert link.statistics.n_retries == 1


def test_turnaround_is_kept():
    modules = KnowingModules()
    line = VirtualLine(lambda data: [(0.0, answer) for answer in modules.receive(data)])
    link = TmclLink(line, LineSettings(turnaround_s=0.004))
    link.exchange(read(1, 0))
    link.exchange(read(1, 0))
    times_s = [at_s for at_s, _ in line.written]
    rests_s = [after - before for before, after in pairwise(times_s)]
    # the link computes the rest that is left with the computer's clock, which runs on between its two looks at it
    assert all(0.003 < rest_s <= 0.004 for rest_s in rests_s)


def test_a_line_that_is_never_silent():
    line = VirtualLine(lambda _: [(0.0, b"\x55" * 40)] * 5000)
    link = TmclLink(line, LineSettings(timeout_s=0.02, n_retries=2, silence_s=0.002))
    with pytest.raises(CommunicationError, match="TMCL module 1"):
        link.exchange(read(1, 0))
    assert link.statistics.n_garbage_bytes > 1000


def test_unplugged_and_plugged_again():
    modules = KnowingModules()
    line = VirtualLine(lambda data: [(0.0, answer) for answer in modules.receive(data)])
    link = TmclLink(line, SETTINGS)
    link.exchange(read(1, 0))
    line.is_plugged = False
    for n_tried in (1, 2):
        with pytest.raises(CommunicationError, match="TMCL module 1 on virtual line: the line is gone: unplugged"):
            link.exchange(read(1, 0))
        # opening a line whose host is off takes seconds: once per question
        assert line.n_reopened == n_tried
    line.is_plugged = True
    assert link.exchange(read(1, 3)).value == number_of(read(1, 3))


def zaber_peer(answer):
    """A peer whose answers `answer(command)` gives, as lines."""
    parser = zaber.CommandParser()

    def peer(data: bytes) -> bytes:
        parser.receive_data(data)
        command = parser.next_message()
        return b"" if command is None else answer(command)

    return peer


def ok(command, data, **changes):
    fields = {"device": command.device, "axis": command.axis, "message_id": command.message_id} | changes
    return zaber.Reply(is_ok=True, status=zaber.Status.IDLE, data=data, **fields).encode()


def test_zaber_ids_tell_late_answers():
    """Every answer comes with the one to the command before it in front, and with other devices' noise."""
    last = [b""]

    def answer(command):
        own = ok(command, command.words.removeprefix("get "))
        before, last[0] = last[0], own
        alert = zaber.Alert(command.device, command.axis, zaber.Status.IDLE).encode()
        return alert + before + ok(command, "wrong device", device=9) + own

    link = ZaberLink(LoopbackTransport("loopback://z", zaber_peer(answer)), SETTINGS)
    for number in range(250):
        assert link.exchange(1, 1, f"get {number}").data == str(number)
    assert link.statistics.n_retries == 0


def test_zaber_checksum_is_insisted_on_once_seen():
    """A wrong bit can turn the colon of ":2D" into another character, so that 1234:2D would be read as data."""
    answers = iter([b":", b"\x3b", b":"])

    def answer(command):
        return ok(command, "1234").replace(b":", next(answers))

    link = ZaberLink(LoopbackTransport("loopback://z", zaber_peer(answer)), SETTINGS)
    assert link.exchange(1, 1, "get pos").data == "1234"
    assert link.exchange(1, 1, "get pos").data == "1234"
    assert link.statistics.n_retries == 1


def test_zaber_without_checksums():
    link = ZaberLink(
        LoopbackTransport("loopback://z", zaber_peer(lambda command: ok(command, "7", has_checksum=False))), SETTINGS
    )
    assert link.exchange(1, 1, "get pos").data == "7"


def test_silence_names_the_drive_the_line_and_the_remedy():
    link = ZaberLink(LoopbackTransport("loopback://quiet", lambda _: b""), SETTINGS)
    with pytest.raises(
        CommunicationError, match=r"Zaber device 3 axis 2 on loopback://quiet.*4 attempts.*nothing.*cable"
    ):
        link.exchange(3, 2, "get pos")
    assert link.statistics.n_timeouts == 4
    assert link.statistics.n_retries == 3


HURRIED_S = 0.03


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    late=CHANCE,
    lost=CHANCE,
    questions=st.lists(
        st.tuples(st.integers(1, 3), st.integers(0, 5), st.integers(0, 3), st.booleans()), min_size=1, max_size=25
    ),
)
def test_no_reply_is_taken_for_another_in_a_hurry_either(seed, late, lost, questions):
    link = TmclLink(VirtualLine(BadLuck(seed, late, lost, 0.0, 0.0).peer), SETTINGS)
    for module, motor, type_, is_hurried in questions:
        link.hurry(HURRIED_S if is_hurried else None)
        request = read(module, motor, type_)
        try:
            reply = link.exchange(request)
        except CommunicationError:
            continue
        assert reply.value == number_of(request)


def test_in_a_hurry_all_modules_are_told_at_once_whoever_is_silent():
    line = VirtualLine(lambda data: [])
    link = TmclLink(line, SETTINGS)
    link.hurry(HURRIED_S)
    stops = [tmcl.Request(module, tmcl.Command.MST) for module in range(1, 16)]
    for stop in stops:
        with pytest.raises(CommunicationError, match="in one attempt"):
            link.exchange(stop)
    assert [data for _, data in line.written] == [stop.encode() for stop in stops]
    assert line.written[-1][0] == pytest.approx(14 * HURRIED_S)
    link.hurry(None)
    with pytest.raises(CommunicationError, match="4 attempts"):
        link.exchange(stops[0])


def test_a_question_under_way_is_cut_short_when_a_hurry_begins():
    line = VirtualLine(lambda data: [])
    link = TmclLink(line, SETTINGS)
    pass_on, reads_s = line.read, []

    def read_and_hurry(n_max: int, timeout_s: float) -> bytes:
        reads_s.append(timeout_s)
        if sum(reads_s) > 0.05:
            link.hurry(HURRIED_S)
        return pass_on(n_max, timeout_s)

    line.read = read_and_hurry
    with pytest.raises(CommunicationError):
        link.exchange(read(1, 0))
    assert 0.05 < sum(reads_s) < 0.08
    assert len(line.written) == 1
