"""What the Modbus driver sends for an order, and how it takes drives that do something else."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

from modbus_bus import Bus
from virtual_lines import VirtualLine

from firmware_protocols.modbus_drive import RegisterImage, RegisterMap
from firmware_protocols.modbus_map import read_register_map
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.units import celsius_to_k, mm_to_m
from namod_ctl.devices.drive_maps import builtin_map_names, load_register_map
from namod_ctl.devices.links import LineSettings
from namod_ctl.devices.modbus_drive import ModbusDrive
from namod_ctl.devices.modbus_link import Framing, ModbusLink
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.twin.drive_modbus_units import Cia402Unit
from namod_ctl.twin.drive_motor import DriveMotor, MotorSettings

DRIVES = Path(__file__).parents[3] / "config" / "drives"
MOTOR = MotorSettings()
RANGE_M = (mm_to_m(-5.0), mm_to_m(5.0))
SPEEDS = {"speed_m_per_s": mm_to_m(1.0), "acceleration_m_per_s2": mm_to_m(5.0)}
FLOAT_MAP: dict[str, Any] = {
    "name": "actuator in metres",
    "source": "this test",
    "reached_within": 1e-6,
    "registers": {
        "target": {"address": 10, "type": "float32", "word_order": "low_first", "read": 3, "write": 16, "unit": "m"},
        "position": {"address": 20, "type": "float32", "word_order": "low_first", "read": 4, "unit": "m"},
    },
    "roles": {"target": "target", "position": "position"},
    "sequences": {
        "move": [{"write": "target", "value": "target"}],
        "stop": [{"write": "target", "value": "position"}],
    },
}


class Registers:
    """A drive that is nothing but its registers, and remembers who wrote and read them."""

    def __init__(self, register_map: RegisterMap) -> None:
        self.image = RegisterImage(register_map)
        self.log: list[tuple[str, int, tuple[int, ...] | int]] = []

    def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
        self.log.append(("read", address, count))
        return self.image.read(function, address, count)

    def write(self, function: int, address: int, words: Sequence[int]) -> None:
        self.log.append(("write", address, tuple(words)))
        self.image.write(function, address, words)


class LoggedCia402(Cia402Unit):
    """The twin's drive with a log of its requests."""

    log: list[tuple[str, int, tuple[int, ...] | int]]

    def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
        self.log.append(("read", address, count))
        return super().read(function, address, count)

    def write(self, function: int, address: int, words: Sequence[int]) -> None:
        self.log.append(("write", address, tuple(words)))
        super().write(function, address, words)


def link_to(unit: object) -> ModbusLink:
    bus = Bus(Framing.RTU)
    bus.units[1] = unit  # type: ignore[assignment]
    return ModbusLink(LoopbackTransport("loopback://modbus", bus.receive), LineSettings(), Framing.RTU)


def drive_on(unit: object, register_map: RegisterMap, steps_per_m: float) -> ModbusDrive:
    return ModbusDrive(link_to(unit), 1, register_map, steps_per_m=steps_per_m, range_m=RANGE_M, **SPEEDS)


def cia402(**motor: Any) -> tuple[ModbusDrive, LoggedCia402, DriveMotor]:
    leg = DriveMotor(replace(MOTOR, **motor), 0, is_homed=True)
    unit = LoggedCia402(1, load_register_map("cia402"), leg)
    unit.log = []
    return drive_on(unit, load_register_map("cia402"), MOTOR.steps_per_m), unit, leg


def test_a_start_comes_after_a_whole_target_that_was_read_back() -> None:
    """Profile position mode of IEC 61800-7-201: target, then the rising edge of bit 4, then its acknowledgement."""
    drive, unit, _ = cia402()
    drive.start_move(mm_to_m(3.0))  # 1000 steps of 3 um
    writes = [entry for entry in unit.log if entry[0] == "write"]
    target = ("write", 6940, (0, 1000))
    starts = [index for index, entry in enumerate(unit.log) if entry == ("write", 6914, (0, 0x3F))]
    assert writes.count(target) == 1
    assert [entry for entry in writes if entry[1] in (6940, 6941)] == [target]
    assert len(starts) == 1
    at = unit.log.index(target)
    assert unit.log[at + 1] == ("read", 6940, 2)
    assert at + 1 < starts[0]
    assert any(entry[0] == "read" for entry in unit.log[starts[0] + 1 :])
    before = {word[1] & 0x10 for kind, address, word in unit.log[:at] if kind == "write" and address == 6914}
    assert before == {0}


def test_a_drive_that_is_enabled_keeps_its_power_for_the_next_move() -> None:
    drive, unit, _ = cia402()
    drive.start_move(mm_to_m(1.0))
    unit.log.clear()
    drive.start_move(mm_to_m(2.0))
    words = [entry[2][1] for entry in unit.log if entry[:2] == ("write", 6914)]
    assert all(word & 0x0F == 0x0F for word in words)


def test_a_state_takes_few_requests() -> None:
    drive, unit, _ = cia402()
    drive.state()
    assert len(unit.log) == 3  # status, position, temperature
    drive.start_move(mm_to_m(3.0))
    unit.log.clear()
    assert drive.state().is_moving
    assert len(unit.log) == 2


def test_temperature_is_in_kelvin() -> None:
    drive, _, _ = cia402(ambient_k=celsius_to_k(12.0))
    assert drive.state().temperature_k == pytest.approx(celsius_to_k(12.0))


def test_a_fault_is_told_in_words_and_must_be_cleared() -> None:
    drive, _, leg = cia402(has_encoder=True)
    drive.start_move(mm_to_m(3.0))
    leg.conditions = replace(leg.conditions, lost_share=1.0)
    for tenth in range(1, 60):
        leg.update(tenth / 10.0)
    assert any("0x8611: following error" in fault for fault in drive.state().faults)
    with pytest.raises(DeviceFaultError, match=r"fault state, error 0x8611: following error; clear its faults first"):
        drive.start_move(0.0)
    leg.conditions = replace(leg.conditions, lost_share=0.0)
    drive.clear_faults()
    assert drive.state().faults == ()
    drive.start_move(mm_to_m(1.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_negative_scale_turns_the_leg_round(sign: float) -> None:
    register_map = load_register_map("two_register")
    unit = Registers(register_map)
    drive = drive_on(unit, register_map, sign * 1e6)
    drive.start_move(mm_to_m(1.5))
    assert unit.image["target"] == 20000 + sign * 1500  # 0 is count 20000 of 1 um
    unit.image["position"] = 20000 + sign * 1500
    assert drive.state().position_m == pytest.approx(mm_to_m(1.5))


def test_an_actuator_without_a_stop_is_given_its_own_place() -> None:
    register_map = load_register_map("two_register")
    unit = Registers(register_map)
    drive = drive_on(unit, register_map, 1e6)
    unit.image["position"] = 20777
    drive.start_move(0.0)
    assert drive.state().is_moving
    drive.stop()
    assert unit.image["target"] == 20777
    assert not drive.state().is_moving


def test_a_drive_that_takes_another_target_is_stopped() -> None:
    register_map = load_register_map("two_register")

    class Clipping(Registers):
        """Knows limits of its own and clips silently, as cheap drives do."""

        def write(self, function: int, address: int, words: Sequence[int]) -> None:
            super().write(function, address, [min(words[0], 21000)])

    unit = Clipping(register_map)
    unit.image["position"] = 20500
    drive = drive_on(unit, register_map, 1e6)
    with pytest.raises(DeviceFaultError, match=r"given the target 0\.0012 m and shows 0\.001; it was stopped"):
        drive.start_move(mm_to_m(1.2))
    assert unit.image["target"] == 20500


def test_a_drive_that_never_gets_ready_is_named_with_what_is_missing() -> None:
    raw = tomllib.loads((DRIVES / "cia402.toml").read_text())
    for step in raw["sequences"]["enable"]:
        if "timeout_s" in step:
            step["timeout_s"] = 0.02
    register_map = read_register_map(raw)
    unit = Registers(register_map)
    unit.image["statusword"] = 0x8021  # homed, ready to switch on, and not to be moved from there
    drive = drive_on(unit, register_map, MOTOR.steps_per_m)
    with pytest.raises(DeviceFaultError, match=r"unit 1 .* is not 'disabled' after 0\.02 s: it reports no fault"):
        drive.start_move(0.0)


def test_a_position_in_metres_of_a_float() -> None:
    register_map = read_register_map(FLOAT_MAP)
    unit = Registers(register_map)
    drive = drive_on(unit, register_map, -1.0)
    drive.start_move(mm_to_m(1.0))
    # IEEE 754: -0.001 is 0xBA83126F, low word first
    assert unit.image.read(3, 10, 2) == (0x126F, 0xBA83)
    unit.image["position"] = -0.001
    assert drive.state().position_m == pytest.approx(mm_to_m(1.0), rel=1e-6)
    assert drive.resolution_m < 1e-9


def test_a_position_that_is_no_number_is_not_believed() -> None:
    register_map = read_register_map(FLOAT_MAP)

    class Confused(Registers):
        def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
            return (0, 0x7FC0) if function == 4 else super().read(function, address, count)

    with pytest.raises(CommunicationError, match="position: the peer sent nan"):
        drive_on(Confused(register_map), register_map, 1.0).state()


CHANCE = st.sampled_from([0.0, 0.05, 0.2])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    late=CHANCE,
    lost=CHANCE,
    damaged=CHANCE,
    targets=st.lists(st.integers(-1500, 1500), min_size=1, max_size=4),
)
def test_on_a_bad_line_a_leg_goes_where_it_was_told_or_stays(seed, late, lost, damaged, targets):
    """Whatever a line does to single bits, answers and their times, no other target is ever taken for the leg's."""
    register_map = load_register_map("cia402")
    leg = DriveMotor(MOTOR, 0, is_homed=True)
    bus = Bus(Framing.RTU, seed, late, lost, damaged)
    bus.units[1] = Cia402Unit(1, register_map, leg)
    link = ModbusLink(VirtualLine(bus.peer), LineSettings(timeout_s=0.1, n_retries=3), Framing.RTU)
    drive = ModbusDrive(link, 1, register_map, steps_per_m=MOTOR.steps_per_m, range_m=RANGE_M, **SPEEDS)
    now_s = 0.0
    for target in targets:
        before = leg.target
        try:
            drive.start_move(target / MOTOR.steps_per_m)
        except (CommunicationError, DeviceFaultError):
            assert leg.target in (before, target)
        else:
            assert leg.target == target
        now_s += 20.0
        leg.update(now_s)


def test_names_of_the_maps_of_the_program() -> None:
    assert builtin_map_names() == ["cia402", "pulse_stepper", "two_register"]
    assert load_register_map("cia402") == load_register_map(DRIVES / "cia402.toml")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (None, r"no readable register map .*a built-in name: cia402, pulse_stepper, two_register"),
        ("name = = 1", r"map\.toml: not valid TOML: .*line 1"),
        ("name = 'x'\ncolour = 1", r"map\.toml: colour: unknown(.|\n)*map\.toml: roles\.target: missing"),
        (b"\xff\xfe", r"map\.toml: not valid TOML"),
    ],
)
def test_a_bad_map_is_refused_with_its_file(tmp_path: Path, text: str | bytes | None, problem: str) -> None:
    path = tmp_path / "map.toml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=problem):
        load_register_map(path)


def test_limits_and_speeds_that_the_registers_cannot_hold() -> None:
    register_map = load_register_map("two_register")
    with pytest.raises(ConfigError, match=r"range_m and steps_per_m = 1000000.0 do not fit the drive \(two-register"):
        ModbusDrive(link_to(None), 1, register_map, steps_per_m=1e6, range_m=(-0.03, 0.01), **SPEEDS)
    stepper = load_register_map("pulse_stepper")
    with pytest.raises(ConfigError, match="speed or acceleration"):
        ModbusDrive(
            link_to(None), 1, stepper, steps_per_m=1e5, range_m=RANGE_M, speed_m_per_s=1e3, acceleration_m_per_s2=1.0
        )
