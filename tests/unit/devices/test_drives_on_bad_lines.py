"""TMCL and Zaber drivers on the twin's lines with every fault a line has: no wrong state is reported as a good one.

With faults on, an order may fail with `CommunicationError`; what must not happen is a position, a homed flag or an end
of motion that is not true, or a leg that stands elsewhere than where the driver says it sent it.
"""

from __future__ import annotations

import math
import time

import pytest

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError
from namod_ctl.devices.links import LineSettings, TmclLink, ZaberLink
from namod_ctl.devices.tmcl_drive import TmclDrive
from namod_ctl.devices.transports import LoopbackTransport, open_transport
from namod_ctl.devices.zaber_drive import ZaberDrive
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drive_lines import DriveLine, LoopbackLine, PtyLine
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan, FaultSpec

STEPS_PER_M = 1e6 / 3.0
RANGE_M = (-0.004, 0.004)
PLAY_M = 2e-5
LEGS = [Leg(7, index) for index in range(3)]
SETTINGS = {
    "steps_per_m": STEPS_PER_M,
    "range_m": RANGE_M,
    "speed_m_per_s": 0.001,
    "acceleration_m_per_s2": 0.005,
}
# shares of bytes or telegrams far beyond what a line in use would show
FAULTS = {
    "none": [],
    "bit errors": [FaultSpec("bit_errors", 0.0, None, {"share": 0.01})],
    "noise": [FaultSpec("line_noise", 0.0, None, {"share": 0.5, "count": 12.0})],
    "lost answers": [FaultSpec("lost_answers", 0.0, None, {"share": 0.2})],
    "lost requests": [FaultSpec("lost_requests", 0.0, None, {"share": 0.2})],
    "slow answers": [FaultSpec("slow_answers", 0.0, None, {"share": 0.2})],
    "all of them": [
        FaultSpec("bit_errors", 0.0, None, {"share": 0.003}),
        FaultSpec("line_noise", 0.0, None, {"share": 0.1, "count": 12.0}),
        FaultSpec("lost_answers", 0.0, None, {"share": 0.05}),
        FaultSpec("slow_answers", 0.0, None, {"share": 0.05}),
    ],
}


class Bench:
    """Three legs on one bus of the twin, with their drivers; modules and devices 1 (two motors) and 2 (one)."""

    def __init__(self, protocol: str, faults: list[FaultSpec], seed: int = 5) -> None:
        first = 1 if protocol == "zaber" else 0
        places = [(1, first), (1, first + 1), (2, first)]
        self.clock = ManualClock()
        self.plan = FaultPlan()
        wires = tuple(DriveWire(leg, *place) for leg, place in zip(LEGS, places, strict=True))
        self.twin = TwinDrives([BusWiring("east", protocol, wires)], self.clock, self.plan, seed)
        self.line = DriveLine(self.twin, "east")
        self.transport = LoopbackTransport("loopback://east", LoopbackLine(self.line))
        settings = LineSettings(n_retries=8)
        if protocol == "zaber":
            link = ZaberLink(self.transport, settings)
            self.drives: list[Drive] = [ZaberDrive(link, *place, **SETTINGS) for place in places]
        else:
            link = TmclLink(self.transport, settings)
            self.drives = [TmclDrive(link, *place, **SETTINGS) for place in places]
        self.link = link
        for fault in faults:
            self.plan.inject(fault)

    def true_m(self, leg: Leg) -> float:
        return self.twin.motor(leg).true_leg_steps / STEPS_PER_M

    def obeyed(self, order) -> bool:
        try:
            order()
        except CommunicationError:
            return False
        return True


@pytest.mark.parametrize("faults", FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("protocol", ["tmcl", "zaber"])
def test_what_is_reported_is_true(protocol, faults):
    bench = Bench(protocol, faults)
    n_reports = n_failures = 0
    targets_m = [0.0005, -0.0013, 0.0021, 0.0004, -0.0031, 0.0018]
    for round_number in range(4):
        ordered = {}
        for number, (leg, drive) in enumerate(zip(LEGS, bench.drives, strict=True)):
            target_m = targets_m[(round_number + number) % len(targets_m)]
            if bench.obeyed(lambda d=drive, t=target_m: d.start_move(t)):
                ordered[leg] = target_m
        for _ in range(12):
            bench.clock.wait_s(0.7)
            for leg, drive in zip(LEGS, bench.drives, strict=True):
                try:
                    state = drive.state()
                except CommunicationError:
                    n_failures += 1
                    continue
                n_reports += 1
                assert state.faults == ()
                assert state.is_homed
                assert state.is_moving == bench.twin.motor(leg).is_moving
                if not state.is_moving:
                    assert state.position_m == pytest.approx(bench.true_m(leg), abs=PLAY_M)
                    if leg in ordered:
                        assert state.position_m == pytest.approx(ordered[leg], abs=2.0 / STEPS_PER_M)
    # the drives are alive behind those faults: most questions are answered in the end
    assert n_failures < 0.05 * n_reports
    statistics = bench.link.statistics
    assert (statistics.n_retries + statistics.n_garbage_bytes > 0) == bool(faults)


@pytest.mark.parametrize("protocol", ["tmcl", "zaber"])
def test_always_late_answers_give_an_error_and_no_position(protocol):
    bench = Bench(protocol, [])
    for drive in bench.drives:
        drive.state()
    bench.plan.inject(FaultSpec("slow_answers", 0.0, None, {"share": 1.0}))
    for drive in bench.drives:
        try:
            state = drive.state()
        except CommunicationError:
            continue
        # message ids let Zaber's late answers still be told apart; then they have to be right
        assert state.position_m == pytest.approx(bench.true_m(LEGS[bench.drives.index(drive)]), abs=PLAY_M)


@pytest.mark.parametrize("protocol", ["tmcl", "zaber"])
def test_homing_and_stop_over_a_bad_line(protocol):
    bench = Bench(protocol, FAULTS["all of them"])
    drive, leg = bench.drives[1], LEGS[1]
    assert bench.obeyed(drive.start_homing)
    bench.clock.wait_s(1.0)
    assert not drive.state().is_homed
    bench.clock.wait_s(30.0)
    state = drive.state()
    assert state.is_homed
    assert state.position_m == pytest.approx(bench.true_m(leg), abs=PLAY_M)
    drive.start_move(0.003)
    bench.clock.wait_s(1.0)
    drive.stop()
    bench.clock.wait_s(1.0)
    stopped_m = bench.true_m(leg)
    assert 0.0 < stopped_m < 0.003
    bench.clock.wait_s(10.0)
    assert bench.true_m(leg) == stopped_m
    assert drive.state().position_m == pytest.approx(stopped_m, abs=PLAY_M)


@pytest.mark.parametrize("protocol", ["tmcl", "zaber"])
def test_a_reset_in_mid_move_is_seen_by_a_program_that_starts_anew(protocol):
    bench = Bench(protocol, [])
    bench.drives[0].start_move(0.003)
    bench.clock.wait_s(1.0)
    bench.twin.motor(LEGS[0]).reset()
    bench.clock.wait_s(1.0)
    place = (1, 1) if protocol == "zaber" else (1, 0)
    kind, link = (ZaberDrive, ZaberLink) if protocol == "zaber" else (TmclDrive, TmclLink)
    for drive in (bench.drives[0], kind(link(bench.transport, LineSettings()), *place, **SETTINGS)):
        state = drive.state()
        assert not state.is_homed
        assert math.isnan(state.position_m)
        assert not state.is_moving


def test_a_wrong_bit_that_makes_a_digit_of_the_colon_is_mended_before_the_leg_gets_anywhere():
    """ "move abs 10:85" arrives as "move abs 10285": a good command without checksum, which the device obeys."""
    bench = Bench("zaber", [])
    n_spoiled = 0
    is_next = True

    def spoiled(data: bytes) -> bytes:
        nonlocal n_spoiled, is_next
        if b"move abs" in data:
            if is_next and data.strip()[-2:].isdigit():
                n_spoiled += 1
                data = data.replace(b":", b"2")
                is_next = False
            else:
                is_next = True
        return line(data)

    line = LoopbackLine(bench.line)
    link = ZaberLink(LoopbackTransport("loopback://east", spoiled), LineSettings())
    drive = ZaberDrive(link, 1, 1, **SETTINGS)
    drive.configure()
    for _ in range(40):
        drive.start_move(3e-6)
        assert bench.twin.motor(LEGS[0]).target == 1
        bench.clock.wait_s(10.0)
        assert drive.state().position_m == pytest.approx(3e-6)
    assert n_spoiled > 20
    assert any(entry.order == "move" and abs(entry.end_m) > 5e-4 for entry in bench.twin.log)


def test_a_search_that_finds_no_reference_leaves_the_drive_not_homed():
    """TMCL's status says only that the search is over; the spindle does not turn, so it can not have found anything."""
    bench = Bench("tmcl", [FaultSpec("stuck_leg", 0.0, None, {"facet": 7.0, "leg": 1.0})])
    drive = bench.drives[0]
    drive.start_homing()
    bench.clock.wait_s(120.0)
    state = drive.state()
    assert not state.is_moving
    assert not state.is_homed


@pytest.mark.parametrize("protocol", ["tmcl", "zaber"])
def test_unplugged_and_plugged_in_again_on_a_terminal(protocol):
    bench = Bench(protocol, [])
    with PtyLine(bench.line) as far:
        transport = open_transport(far.port, 115200)
        link, kind = (ZaberLink, ZaberDrive) if protocol == "zaber" else (TmclLink, TmclDrive)
        drive = kind(link(transport, LineSettings()), 1, 1, **SETTINGS)
        leg = LEGS[0] if protocol == "zaber" else LEGS[1]
        drive.start_move(0.001)
        bench.clock.wait_s(10.0)
        assert drive.state().position_m == pytest.approx(0.001, abs=PLAY_M)
        bench.plan.inject(FaultSpec("bus_unplugged", 10.0, 5.0))
        bench.clock.wait_s(1.0)
        with pytest.raises(CommunicationError, match=far.port):
            drive.state()
        bench.clock.wait_s(10.0)
        state = wait_for_answer(drive)
        assert state.is_homed
        assert state.position_m == pytest.approx(bench.true_m(leg), abs=PLAY_M)
        transport.close()


def wait_for_answer(drive: Drive) -> DriveState:
    """The state as soon as the line is there again; the twin's line looks every 20 ms whether it is plugged in."""
    deadline_s = time.monotonic() + 20.0
    while True:
        try:
            return drive.state()
        except CommunicationError:
            assert time.monotonic() < deadline_s
