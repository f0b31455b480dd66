"""The twin's drives as a whole: true travels, wiring faults, faults of motion, lines, and the facets that they tilt."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import serial
from drive_twins import BUS, STEP_M, some_drives
from test_drive_protocols import tmcl
from twins import CALM, STILL, pair, small_config

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import build_twin, with_facet_map
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drive_lines import DriveLine, LoopbackLine, PtyLine, TcpLine
from namod_ctl.twin.drive_settings import MotorSettings
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import DRIVE_CATALOGUE, FaultPlan
from namod_ctl.twin.settings import FaultSpec, TwinSettings
from namod_ctl.twin.twin import Twin

TIGHT = MotorSettings(backlash_m=0.0)
POSITION = tmcl("01 06 01 00 00 00 00 00")


def order(drives: TwinDrives, address: int, target: int) -> None:
    """MVP ABS."""
    answer = drives.receive(BUS, tmcl(f"{address:02x} 04 00 00 {target & 0xFFFFFFFF:08x}"))
    assert answer[2] == 100


def travels(drives: TwinDrives, duration_s: float = 10.0) -> dict[tuple[int, int], float]:
    """True travels in steps that would be theirs, after a while."""
    drives.clock.wait_s(duration_s)
    drives.update(drives.clock.monotonic_s())
    return {(leg.facet_id, leg.index): drives.travel_m(leg) / STEP_M for leg in drives.legs}


def inject(drives: TwinDrives, name: str, **params: float | str) -> None:
    drives.inject(FaultSpec(name, drives.clock.monotonic_s(), None, params))


def tight(**changes: object) -> TwinDrives:
    return some_drives(motor=TIGHT, **changes)


def test_travel_counts_from_where_the_leg_stood() -> None:
    drives = tight(start_spread_m=mm_to_m(1.0))
    start = drives.motor(Leg(7, 0)).count
    assert start != 0
    assert start != tight(start_spread_m=mm_to_m(1.0), seed=2).motor(Leg(7, 0)).count
    order(drives, 1, start + 120)
    assert travels(drives) == pytest.approx({(7, 0): 120, (7, 1): 0, (7, 2): 0})


def test_wiring_faults_move_other_legs_or_otherwise() -> None:
    drives = tight(facets=(7, 8), n_legs=2)
    inject(drives, "wrong_sign", facet=7, leg=1)
    inject(drives, "wrong_scale", facet=7, leg=2, factor=2.0)
    for address in (1, 2, 3):
        order(drives, address, 100)
    assert travels(drives) == pytest.approx({(7, 0): -100, (7, 1): 200, (8, 0): 100, (8, 1): 0})


def test_swapped_addresses_and_facets_move_each_other() -> None:
    drives = tight(facets=(7, 8), n_legs=2)
    inject(drives, "swapped_addresses", facet=7, leg=1, other_facet=7, other_leg=2)
    order(drives, 1, 100)
    assert travels(drives) == pytest.approx({(7, 0): 0, (7, 1): 100, (8, 0): 0, (8, 1): 0})
    other = tight(facets=(7, 8), n_legs=2)
    inject(other, "wrong_facet", facet=7, other_facet=8)
    order(other, 2, 100)
    assert travels(other) == pytest.approx({(7, 0): 0, (7, 1): 0, (8, 0): 0, (8, 1): 100})


def test_what_was_travelled_before_a_wiring_fault_stays() -> None:
    drives = tight()
    order(drives, 1, 100)
    travels(drives)
    inject(drives, "wrong_sign", facet=7, leg=1)
    assert travels(drives)[7, 0] == pytest.approx(100)
    order(drives, 1, 130)
    assert travels(drives)[7, 0] == pytest.approx(70)


@pytest.mark.parametrize(("n_moving", "kept"), [(2, 1.0), (3, 0.6)])
def test_the_supply_sags_under_too_many(n_moving: int, kept: float) -> None:
    drives = tight()
    inject(drives, "supply_sag", count=2, share=0.4)
    for address in range(1, n_moving + 1):
        order(drives, address, 300)
    expected = {(7, leg): 300 * kept if leg < n_moving else 0.0 for leg in range(3)}
    assert travels(drives) == pytest.approx(expected)


def test_the_supply_recovers_when_one_has_arrived() -> None:
    """Three go, one only 60 steps (0.4 s at 333 steps/s and 1667 steps/s2); until then all lose."""
    drives = tight()
    inject(drives, "supply_sag", count=2, share=0.5)
    for address, target in ((1, 600), (2, 600), (3, 60)):
        order(drives, address, target)
    found = travels(drives)
    way = 0.5 * 1666.67 * 0.2**2 + 333.33 * (2 * (60 / 1666.67) ** 0.5 - 0.2)  # of the others by then
    assert found[7, 2] == pytest.approx(30)
    assert found[7, 0] == pytest.approx(600 - 0.5 * way, rel=1e-3)


@pytest.mark.parametrize("n_looks", [1, 37])
def test_a_fault_acts_while_it_lasts_however_often_one_looks(n_looks: int) -> None:
    """Stuck from 1 s to 2 s of a move at 333 steps/s, the whole number that the module takes for its 333.3."""
    drives = tight()
    drives.inject(FaultSpec("stuck_leg", 1.0, 1.0, {"facet": 7, "leg": 1}))
    order(drives, 1, 1000)
    for _ in range(n_looks):
        drives.clock.wait_s(10.0 / n_looks)
        drives.update(drives.clock.monotonic_s())
    assert travels(drives)[7, 0] == pytest.approx(1000 - 333)


def test_a_drive_is_reset_half_way_through_its_next_move_and_once() -> None:
    drives = tight()
    inject(drives, "drive_reset", facet=7, leg=1)
    assert travels(drives)[7, 0] == 0
    assert drives.motor(Leg(7, 0)).is_homed
    order(drives, 1, 600)
    assert travels(drives)[7, 0] == pytest.approx(300)
    motor = drives.motor(Leg(7, 0))
    assert (motor.count, motor.is_homed) == (0, False)
    order(drives, 1, 600)
    assert travels(drives)[7, 0] == pytest.approx(900)


def test_a_drive_is_reset_at_a_moment() -> None:
    drives = tight()
    drives.inject(FaultSpec("drive_reset", 5.0, None, {"facet": 7, "leg": 3, "is_in_move": 0.0}))
    travels(drives, 4.0)
    assert drives.motor(Leg(7, 2)).is_homed
    travels(drives, 2.0)
    assert [drives.motor(Leg(7, leg)).is_homed for leg in range(3)] == [True, True, False]


def test_the_log_holds_every_order_once_and_what_came_of_it() -> None:
    drives = tight()
    order(drives, 1, 100)
    drives.receive(BUS, POSITION)
    travels(drives)
    entries = [(entry.leg, entry.order, entry.start_m, entry.end_m) for entry in drives.log]
    assert entries == [(Leg(7, 0), "move", 0.0, 100 * STEP_M), (Leg(7, 0), "arrived", 0.0, 100 * STEP_M)]


@pytest.mark.parametrize(
    ("name", "params", "told"),
    [
        ("stuck_leg", {"facet": 9.0}, "facets with drives"),
        ("wrong_sign", {"leg": 1.0}, "facets with drives"),
        ("wrong_sign", {"facet": 7.0, "leg": 4.0}, r"legs \[1, 2, 3\]"),
        ("same_address", {"facet": 7.0}, "other_facet"),
        ("bit_errors", {"bus": "west"}, "east"),
        ("bit_errors", {"bus": 3.0}, "bus"),
    ],
)
def test_a_fault_of_what_has_no_drive_is_refused(name: str, params: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        some_drives().inject(FaultSpec(name, 0.0, None, params))


@pytest.mark.parametrize("name", sorted(DRIVE_CATALOGUE))
def test_without_drives_there_are_no_faults_of_drives(name: str) -> None:
    with pytest.raises(ConfigError, match="no drives"):
        TwinDrives([], ManualClock(), FaultPlan(), 1).inject(FaultSpec(name))


def test_wiring_that_contradicts_itself_is_refused() -> None:
    leg = Leg(1, 0)
    for wires in ((DriveWire(leg, 1), DriveWire(leg, 2)), (DriveWire(leg, 1), DriveWire(Leg(1, 1), 1))):
        with pytest.raises(ConfigError, match="bus 'a'"):
            TwinDrives([BusWiring("a", "tmcl", wires)], ManualClock(), some_drives().faults, 1)


def test_threads_of_lines_and_the_twin_share_the_drives() -> None:
    """Four lines ask without end while the clock runs: nothing is lost, and the way is as long as without them."""
    drives = tight()
    order(drives, 1, 1000)
    answers: list[bytes] = []

    def ask() -> None:
        line = LoopbackLine(DriveLine(drives, BUS))
        answers.extend(line(tmcl("02 06 01 00 00 00 00 00")) for _ in range(200))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in range(500):
        drives.clock.wait_s(0.01)
        drives.update(drives.clock.monotonic_s())
    for thread in threads:
        thread.join()
    assert answers == [tmcl("02 02 64 06 00 00 00 00")] * 800
    assert travels(drives) == pytest.approx({(7, 0): 1000, (7, 1): 0, (7, 2): 0})


# --- lines


@pytest.mark.parametrize("name", ["bit_errors", "line_noise", "lost_answers", "lost_requests", "slow_answers"])
def test_faults_of_a_line_disturb_what_passes_and_repeat(name: str) -> None:
    def heard(is_faulty: bool) -> list[bytes]:
        drives = some_drives()
        if is_faulty:
            inject(drives, name, share=0.3, bus=BUS)
        peer = LoopbackLine(DriveLine(drives, BUS))
        return [peer(POSITION) for _ in range(60)]

    clean, faulty = heard(False), heard(True)
    n_other = sum(a != b for a, b in zip(clean, faulty, strict=True))
    assert heard(True) == faulty
    assert 5 < n_other <= 60
    assert set(clean) == {tmcl("02 01 64 06 00 00 00 00")}
    if name == "slow_answers":
        assert b"".join(faulty) == b"".join(clean)[: len(b"".join(faulty))]


def test_a_loopback_that_is_pulled_out_is_gone_until_it_is_plugged_in() -> None:
    drives = some_drives()
    peer = LoopbackLine(DriveLine(drives, BUS))
    drives.inject(FaultSpec("bus_unplugged", 1.0, 1.0))
    assert peer(POSITION)
    drives.clock.wait_s(1.0)
    with pytest.raises(CommunicationError, match="unplugged"):
        peer(POSITION)
    drives.clock.wait_s(1.0)
    assert peer(POSITION)


def test_a_pty_answers_is_unplugged_and_plugged_in_again_at_the_same_path() -> None:
    drives = some_drives()
    with PtyLine(DriveLine(drives, BUS)) as line:
        with serial.Serial(line.port, timeout=5.0) as port:
            port.write(POSITION)
            assert port.read(9) == tmcl("02 01 64 06 00 00 00 00")
            drives.inject(FaultSpec("bus_unplugged", 0.0, 1.0))
            with pytest.raises((serial.SerialException, OSError)):
                ask_until_gone(port)
        drives.clock.wait_s(2.0)
        wait_until(lambda: Path(line.port).exists())
        with serial.Serial(line.port, timeout=5.0) as port:
            port.write(POSITION)
            assert len(port.read(9)) == 9
    assert not Path(line.port).exists()


def test_a_tcp_line_is_reset_when_unplugged_and_comes_back_at_its_port() -> None:
    drives = some_drives()
    with TcpLine(DriveLine(drives, BUS)) as line:
        with socket.create_connection((line.host, line.port), timeout=5.0) as client:
            client.sendall(POSITION)
            assert client.recv(100) == tmcl("02 01 64 06 00 00 00 00")
            drives.inject(FaultSpec("bus_unplugged", 0.0, 1.0))
            with pytest.raises(ConnectionResetError):
                client.recv(1)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((line.host, line.port), timeout=5.0)
        drives.clock.wait_s(2.0)
        wait_until(lambda: answers_on(line))
        port = line.port
    with TcpLine(DriveLine(drives, BUS), port) as again:
        assert answers_on(again)


def ask_until_gone(port: serial.Serial) -> None:
    for _ in range(500):
        port.write(POSITION)
        assert port.read(1) == b""


def answers_on(line: TcpLine) -> bool:
    try:
        with socket.create_connection((line.host, line.port), timeout=5.0) as client:
            client.sendall(POSITION)
            return len(client.recv(100)) == 9
    except ConnectionRefusedError:
        return False


def wait_until(is_so: Callable[[], bool]) -> None:
    """The line's thread looks every 20 ms at its plug."""
    for _ in range(500):
        if is_so():
            return
        threading.Event().wait(0.01)
    raise AssertionError("it did not happen within 5 s")


# --- the facets that they tilt


def actuated_twin(seed: int = 3) -> Twin:
    instrument = with_facet_map(build_instrument(small_config()))
    wires = []
    for address, (facet, leg) in enumerate(
        [(facet, leg) for facet, mount in instrument.mounts.items() for leg in range(len(mount.legs_m))], start=1
    ):
        wires.append(DriveWire(Leg(facet, leg), address))
    settings = TwinSettings(sky=CALM, telescope=STILL)
    return Twin(instrument, settings, seed, [BusWiring(BUS, "tmcl", tuple(wires), motor=TIGHT)])


def test_legs_tilt_their_facet_as_if_moved_by_hand() -> None:
    driven, by_hand = actuated_twin(), build_twin(small_config(), TwinSettings(sky=CALM, telescope=STILL), 3)
    facet = driven.reflector.ids[1]
    legs = [leg for leg in driven.drives.legs if leg.facet_id == facet]
    before = driven.true_theta_rad
    steps = (150, -60, 30)
    wires = {wire.leg: wire.address for wire in driven.drives.wiring[BUS].wires}
    for leg, way in zip(legs, steps, strict=True):
        order(driven.drives, wires[leg], driven.drives.motor(leg).count + way)
    for twin in (driven, by_hand):
        twin.update(10.0)
    by_hand.move_legs(facet, np.array(steps) * STEP_M)
    np.testing.assert_allclose(driven.true_tilt_rad, by_hand.true_tilt_rad, rtol=0, atol=1e-12)
    moved = np.linalg.norm(driven.true_theta_rad - before, axis=1) > 1e-6
    assert list(np.flatnonzero(moved)) == [1]
    for image, other in zip(pair(driven), pair(by_hand), strict=True):
        np.testing.assert_array_equal(image, other)


def test_a_facet_under_way_is_seen_where_it_was_when_the_exposure_began() -> None:
    one, other = actuated_twin(), actuated_twin()
    for twin in (one, other):
        for address in (1, 4, 7):
            order(twin.drives, address, 3000)
        twin.update(0.5)
        twin.star_camera.start(0.9)
        twin.reflector_camera.start(0.05)
    one.star_camera.fetch(1.0)
    np.testing.assert_array_equal(one.reflector_camera.fetch(1.0).image, other.reflector_camera.fetch(1.0).image)


def test_only_facets_that_moved_are_traced_again(monkeypatch: pytest.MonkeyPatch) -> None:
    twin = actuated_twin()
    pair(twin)
    traced: list[int] = []
    kind = type(twin.reflector.surfaces[0])
    trace = kind.hit_slopes

    def noted(surface, *arguments):
        traced.append(surface.facet.id)
        return trace(surface, *arguments)

    monkeypatch.setattr(kind, "hit_slopes", noted)
    pair(twin)
    assert traced == []
    order(twin.drives, 1, twin.drives.motor(Leg(twin.reflector.ids[0], 0)).count + 50)
    twin.update(twin.clock.monotonic_s() + 5.0)
    pair(twin)
    assert set(traced) == {twin.reflector.ids[0]}


def test_backlash_keeps_a_facet_still_until_it_is_taken_up() -> None:
    drives = some_drives()
    order(drives, 1, 100)
    up = travels(drives)[7, 0]
    order(drives, 1, 97)
    assert travels(drives)[7, 0] == up
    order(drives, 1, 90)
    assert travels(drives)[7, 0] == pytest.approx(up - (10 - um_to_m(10.0) / STEP_M))
