"""A world that was dropped at any moment and opened again is the world that was never dropped."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_twins import BUS, register_map
from test_drive_protocols import tmcl
from twins import CALM, STILL, small_config

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import with_facet_map
from namod_ctl.core.drives import Drive, Leg
from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.units import mm_to_m
from namod_ctl.devices.buses import BusSettings, DriveSettings, open_bus
from namod_ctl.devices.links import LineSettings
from namod_ctl.twin.drive_lines import DriveLine, LoopbackLine
from namod_ctl.twin.drive_motor import DriveMotor
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire, Protocol
from namod_ctl.twin.settings import FaultSpec, TwinSettings
from namod_ctl.twin.twin import Twin
from namod_ctl.twin.world import open_world

INSTRUMENT = with_facet_map(build_instrument(small_config()))
LEGS = [Leg(facet, leg) for facet, mount in INSTRUMENT.mounts.items() for leg in range(len(mount.legs_m))]
SETTINGS = TwinSettings(sky=CALM, telescope=STILL)
RANGE_M = (mm_to_m(-9.0), mm_to_m(9.0))
ROUNDING_STEPS = 1e-9
"""Sums along a ramp that were split by questions at other moments; a step is 3 um."""


def a_twin(protocol: Protocol = "tmcl", map_name: str = "cia402", *, seed: int = 3, **changes: object) -> Twin:
    per_m = 1e6 if map_name == "two_register" else 333_333.0
    wires = tuple(DriveWire(leg, address, int(protocol == "zaber"), per_m) for address, leg in enumerate(LEGS, start=1))
    given = register_map(map_name) if protocol.startswith("modbus") else None
    bus = replace(BusWiring(BUS, protocol, wires, register_map=given), **changes)
    return Twin(INSTRUMENT, SETTINGS, seed, [bus])


def drives_of(twin: Twin) -> dict[Leg, Drive]:
    """The product's drivers on the twin's line, as a program that begins has them."""
    wiring = twin.drives.wiring[BUS]
    wires = tuple(DriveSettings(wire.leg, wire.address, wire.axis, wire.steps_per_m) for wire in wiring.wires)
    settings = BusSettings(
        BUS, f"loopback://{BUS}", wiring.protocol, 115200, LineSettings(), 4, wires, RANGE_M, 5e-4, 2e-3,
        wiring.register_map,
    )  # fmt: skip
    bus = open_bus(settings, {BUS: LoopbackLine(DriveLine(twin.drives, BUS))})
    assert not bus.connect()
    return bus.drives


def everything(motor: DriveMotor) -> dict[str, object]:
    return {key: value for key, value in vars(motor).items() if key not in ("_note", "settings")}


def assert_same(one: Twin, other: Twin) -> None:
    """To the last bit. Looking at motors splits their sums at that moment: nobody may have before."""
    assert one.clock.monotonic_s() == other.clock.monotonic_s()
    assert one.drives.log == other.drives.log
    for leg in LEGS:
        assert everything(one.drives.motor(leg)) == everything(other.drives.motor(leg)), leg
    np.testing.assert_array_equal(one.true_theta_rad, other.true_theta_rad)
    assert one.star_camera.n_frames == other.star_camera.n_frames


def orders(seed: int, count: int) -> list[tuple[float, str, tuple[object, ...]]]:
    """What comes in from outside, at random."""
    rng = random.Random(seed)
    found: list[tuple[float, str, tuple[object, ...]]] = []
    now_s = 0.0
    for _ in range(count):
        now_s += rng.choice([0.0, 0.01, rng.uniform(0.1, 0.9)])
        kind = rng.choices(["move", "stop", "home", "update", "fault", "bolts", "frame"], [8, 2, 1, 4, 1, 1, 1])[0]
        leg = rng.randrange(len(LEGS))
        if kind == "fault":
            name = rng.choice(["stuck_leg", "wrong_sign", "lost_steps", "drive_reset", "supply_sag", "bit_errors"])
            whom = {} if name in ("supply_sag", "bit_errors") else {"facet": LEGS[leg].facet_id, "leg": 1.0}
            found.append((now_s, kind, (name, rng.choice([None, 2.0]), whom)))
        else:
            found.append((now_s, kind, (leg, rng.randint(-2000, 2000))))
    return found


def carry_out(twin: Twin, time_s: float, kind: str, given: tuple) -> None:
    twin.clock.advance_to_s(time_s)
    match kind:
        case "move":
            twin.drives.receive(BUS, tmcl(f"{given[0] + 1:02x} 04 00 00 {given[1] & 0xFFFFFFFF:08x}"))
        case "stop":
            twin.drives.receive(BUS, tmcl(f"{given[0] + 1:02x} 03 00 00 00 00 00 00"))
        case "home":
            twin.drives.receive(BUS, tmcl(f"{given[0] + 1:02x} 0d 00 00 00 00 00 00"))
        case "update":
            twin.update(time_s)
        case "fault":
            twin.inject(given[0], duration_s=given[1], **given[2])
        case "bolts":
            twin.move_legs(LEGS[given[0]].facet_id, np.array([1e-8 * given[1], 0.0, 1e-6]))
        case "frame":
            twin.star_camera.start(0.02)
            twin.star_camera.fetch(1.0)


@pytest.mark.parametrize("seed", range(6))
def test_a_world_dropped_and_opened_again_and_again_is_the_same(tmp_path: Path, seed: int) -> None:
    todo = orders(seed, 160)
    deaths = set(random.Random(seed + 100).sample(range(160), 4))
    whole, mortal = a_twin(), a_twin()
    open_world(tmp_path / "world.jsonl", mortal)
    for number, (time_s, kind, given) in enumerate(todo):
        if number in deaths:
            mortal = a_twin()
            open_world(tmp_path / "world.jsonl", mortal, dead_s=0.75)
            whole.update(whole.clock.monotonic_s() + 0.75)
            assert mortal.drives.log == whole.drives.log
        for twin in (whole, mortal):
            carry_out(twin, time_s, kind, given)
    assert_same(mortal, whole)
    assert {entry.order for entry in whole.drives.log} >= {"move", "arrived", "home"}


@pytest.mark.parametrize(
    ("protocol", "map_name"),
    [
        ("tmcl", ""),
        ("zaber", ""),
        ("modbus_rtu", "cia402"),
        ("modbus_tcp", "pulse_stepper"),
        ("modbus_rtu", "two_register"),
    ],
)
def test_a_program_that_begins_anew_finds_the_drives_as_they_were_left(
    tmp_path: Path, protocol: Protocol, map_name: str
) -> None:
    """Homed by the dead program, killed in mid-move: still homed, and the move came to its end."""
    path = tmp_path / "world.jsonl"
    twin = a_twin(protocol, map_name, is_homed=False)
    open_world(path, twin)
    leg = LEGS[4]
    drive = drives_of(twin)[leg]
    drive.start_homing()
    while drive.state().is_moving:
        twin.clock.wait_s(0.2)
    drive.start_move(mm_to_m(2.0))
    twin.clock.wait_s(1.3)
    assert drive.state().is_moving
    before = twin.drives.motor(leg).true_spindle_steps

    reborn = a_twin(protocol, map_name, is_homed=False)
    open_world(path, reborn, dead_s=0.0)
    reborn.update(twin.clock.monotonic_s())
    assert reborn.drives.motor(leg).true_spindle_steps == pytest.approx(before, rel=0, abs=ROUNDING_STEPS)
    assert reborn.drives.log == twin.drives.log
    state = drives_of(reborn)[leg].state()
    assert state.is_moving
    assert state.is_homed

    later = a_twin(protocol, map_name, is_homed=False)
    open_world(path, later)
    state = drives_of(later)[leg].state()
    assert (state.is_moving, state.is_homed, state.faults) == (False, True, ())
    assert state.position_m == pytest.approx(mm_to_m(2.0), abs=2e-6)
    other = drives_of(later)[LEGS[0]].state()
    assert other.is_homed == (map_name == "two_register")  # its sensor always knows


def test_damage_on_the_line_is_not_done_a_second_time(tmp_path: Path) -> None:
    """What the drives heard is written, not what was sent: a lost order stays lost."""
    twin = a_twin()
    open_world(tmp_path / "world.jsonl", twin)
    twin.inject("lost_requests", share=0.5)
    line = LoopbackLine(DriveLine(twin.drives, BUS))
    for address in range(1, len(LEGS) + 1):
        line(tmcl(f"{address:02x} 04 00 00 00 00 03 00"))
    moved = [entry.leg for entry in twin.drives.log]
    assert 0 < len(moved) < len(LEGS)
    reborn = a_twin()
    open_world(tmp_path / "world.jsonl", reborn, dead_s=0.0)
    assert [entry.leg for entry in reborn.drives.log] == moved


def test_every_order_that_was_answered_survives_a_kill_once(tmp_path: Path) -> None:
    """SIGKILL of a real process in the middle of its orders; it says "k" after the answer to its k-th."""
    program = textwrap.dedent(f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from pathlib import Path
        from test_drive_protocols import tmcl
        from test_world import a_twin, open_world, LEGS, BUS
        twin = a_twin()
        open_world(Path(sys.argv[1]), twin)
        number = 0
        while True:
            number += 1
            twin.clock.wait_s(0.01)
            address = number % len(LEGS) + 1
            assert twin.drives.receive(BUS, tmcl(f"{{address:02x}} 04 00 00 {{number:08x}}"))[2] == 100
            print(number, flush=True)
    """)
    path = tmp_path / "world.jsonl"
    with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for _ in range(137):
            child.stdout.readline()
        os.kill(child.pid, signal.SIGKILL)
        n_answered = 137 + len(child.stdout.read().split())
    reborn = a_twin()
    open_world(path, reborn)
    per_m = reborn.drives.wiring[BUS].wires[0].steps_per_m
    targets = [round(entry.end_m * per_m) for entry in reborn.drives.log if entry.order == "move"]
    assert targets in ([*range(1, n_answered + 1)], [*range(1, n_answered + 2)])  # one may have been unanswered


@pytest.mark.parametrize("n_cut", [1, 7, 30])
def test_a_torn_last_line_never_happened(tmp_path: Path, n_cut: int) -> None:
    path = tmp_path / "world.jsonl"
    twin = a_twin()
    open_world(path, twin)
    for address in (1, 2):
        twin.drives.receive(BUS, tmcl(f"{address:02x} 04 00 00 00 00 03 00"))
    path.write_bytes(path.read_bytes()[:-n_cut])
    reborn = a_twin()
    open_world(path, reborn)
    reborn.drives.receive(BUS, tmcl("03 04 00 00 00 00 03 00"))
    again = a_twin()
    open_world(path, again)
    assert [entry.leg for entry in again.drives.log if entry.order == "move"] == [LEGS[0], LEGS[2]]


@pytest.mark.parametrize("damage", [b"{}", b"[]", b'{"t": 1.0, "bus": "west", "telegram": "00"}', b"\xff\x00", b""])
def test_a_damaged_line_is_named(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "world.jsonl"
    twin = a_twin()
    open_world(path, twin)
    twin.update(1.0)
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([lines[0], damage, *lines[1:], b""]))
    with pytest.raises(StoreError, match=r"line 2 .*damaged"):
        open_world(path, a_twin())


def test_the_world_of_another_twin_is_refused(tmp_path: Path) -> None:
    open_world(tmp_path / "world.jsonl", a_twin())
    for other in (a_twin(seed=4), a_twin("zaber"), a_twin(start_spread_m=0.0)):
        with pytest.raises(ConfigError, match="another twin"):
            open_world(tmp_path / "world.jsonl", other)


def test_an_order_that_cannot_be_written_is_not_obeyed(tmp_path: Path) -> None:
    """The disk is full, here: the file may not grow any more."""
    path = tmp_path / "world.jsonl"
    twin = a_twin()
    open_world(path, twin)
    before = path.read_bytes()
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, allowed[1]))
        with pytest.raises(StoreError, match="make room"):
            twin.drives.receive(BUS, tmcl("01 04 00 00 00 00 03 00"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
        signal.signal(signal.SIGXFSZ, ignored)
    assert twin.drives.log == ()
    assert path.read_bytes() == before


def test_a_long_world_is_read_in_two_seconds(tmp_path: Path) -> None:
    """100 000 lines: nights of frames, and 5000 orders of up to 1 mm."""
    path = tmp_path / "world.jsonl"
    twin = a_twin()
    world = open_world(path, twin)
    lines = []
    for number in range(100_000):
        what: dict[str, object] = {"t": 0.2 * number, "frames": [number, number]}
        if number % 20 == 0:
            address, target = number // 20 % len(LEGS) + 1, number % 600 - 300
            telegram = tmcl(f"{address:02x} 04 00 00 {target & 0xFFFFFFFF:08x}")
            what = {"t": 0.2 * number, "bus": BUS, "telegram": telegram.hex()}
        lines.append(json.dumps(what) + "\n")
    with path.open("a") as file:
        file.writelines(lines)
    world.close()
    reborn = a_twin()
    begun = time.process_time()
    open_world(path, reborn)
    assert time.process_time() - begun < 2.0
    assert len([entry for entry in reborn.drives.log if entry.order == "move"]) == 5000


def test_faults_that_were_injected_go_on(tmp_path: Path) -> None:
    path = tmp_path / "world.jsonl"
    twin = a_twin()
    open_world(path, twin)
    twin.update(2.0)
    facet = LEGS[0].facet_id
    given = [
        twin.inject("clouds", factor=10.0),
        twin.drives.inject(FaultSpec("stuck_leg", 1.0, 7.5, {"facet": facet, "leg": 1})),
    ]
    reborn = a_twin()
    open_world(path, reborn, dead_s=0.0)
    found = [*reborn.drives.faults.of("clouds"), *reborn.drives.faults.of("stuck_leg")]
    assert found == given
