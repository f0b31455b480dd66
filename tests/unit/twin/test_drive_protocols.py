"""What the twin's drives answer on the wire, byte for byte, by the protocols' manuals."""

from __future__ import annotations

import struct

import pytest
from drive_twins import BUS, register_map, some_drives
from hypothesis import given, settings
from hypothesis import strategies as st

from namod_ctl.core.drives import Leg
from namod_ctl.twin.drive_modbus_units import Cia402Unit
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.settings import FaultSpec

LEG = Leg(7, 0)
PROTOCOLS = ("tmcl", "zaber", "modbus_rtu", "modbus_tcp")


def tmcl(text: str) -> bytes:
    """A frame of eight bytes in hexadecimal with its sum."""
    body = bytes.fromhex(text)
    return body + bytes([sum(body) % 256])


def rtu(text: str) -> bytes:
    """A Modbus RTU frame with its check sum, by the polynomial of the standard."""
    body = bytes.fromhex(text)
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return body + struct.pack("<H", crc)


def passed(drives: TwinDrives, duration_s: float) -> None:
    drives.clock.wait_s(duration_s)
    drives.update(drives.clock.monotonic_s())


# --- TMCL


def test_a_tmcl_module_moves_and_tells() -> None:
    """MVP ABS 300 to module 1, by the manual's layout; then position, target, reached, speed."""
    drives = some_drives()
    assert drives.receive(BUS, tmcl("01 04 00 00 00 00 01 2c")) == tmcl("02 01 64 04 00 00 01 2c")
    reached = tmcl("01 06 08 00 00 00 00 00")
    passed(drives, 0.1)
    assert drives.receive(BUS, reached) == tmcl("02 01 64 06 00 00 00 00")
    passed(drives, 2.0)
    assert drives.receive(BUS, reached) == tmcl("02 01 64 06 00 00 00 01")
    assert drives.receive(BUS, tmcl("01 06 01 00 00 00 00 00")) == tmcl("02 01 64 06 00 00 01 2c")
    assert drives.motor(LEG).true_spindle_steps == 300


@pytest.mark.parametrize(
    ("request_hex", "status"),
    [
        ("01 f0 00 00 00 00 00 00", 2),  # no such command
        ("01 04 09 00 00 00 00 01", 3),  # no such kind of move
        ("01 06 fa 00 00 00 00 00", 3),  # no such parameter
        ("01 06 01 05 00 00 00 00", 4),  # no such motor
        ("01 05 04 00 00 0f 42 40", 4),  # a speed it cannot reach
        ("01 05 05 00 00 00 00 00", 4),  # no acceleration
        ("01 0a 00 07 00 00 00 00", 3),  # no such bank
    ],
)
def test_a_tmcl_module_says_what_is_wrong(request_hex: str, status: int) -> None:
    drives = some_drives()
    answer = drives.receive(BUS, tmcl(request_hex))
    assert (answer[0], answer[1], answer[2], answer[3]) == (2, 1, status, bytes.fromhex(request_hex)[1])
    assert sum(answer[:8]) % 256 == answer[8]
    assert not drives.motor(LEG).is_moving


def test_a_tmcl_module_refuses_a_wrong_sum_and_hears_the_next_telegram() -> None:
    drives = some_drives()
    good = tmcl("01 04 00 00 00 00 01 2c")
    answer = drives.receive(BUS, good[:-1] + bytes([good[-1] ^ 1]))
    assert answer[2] == 1
    assert not drives.motor(LEG).is_moving
    assert drives.receive(BUS, good)[2] == 100


def test_a_tmcl_module_hears_a_telegram_byte_by_byte_and_behind_garbage() -> None:
    drives = some_drives()
    frame = tmcl("01 06 01 00 00 00 00 00")
    answers = [drives.receive(BUS, frame[i : i + 1]) for i in range(9)]
    assert [len(answer) for answer in answers] == [0] * 8 + [9]
    assert drives.receive(BUS, b"\x55\xaa\x00" + frame)[-9:] == answers[-1]


def test_a_module_that_is_not_there_is_silent() -> None:
    assert some_drives().receive(BUS, tmcl("63 06 01 00 00 00 00 00")) == b""
    assert some_drives("zaber").receive(BUS, b"/42 1 get pos\n") == b""
    assert some_drives("modbus_rtu").receive(BUS, rtu("63 03 10 03 00 01")) == b""


def test_a_tmcl_module_forgets_its_variables_and_speed_at_a_reset() -> None:
    drives = some_drives()
    is_homed, speed = tmcl("01 0a 40 02 00 00 00 00"), tmcl("01 06 04 00 00 00 00 00")
    assert drives.receive(BUS, is_homed)[4:8] == b"\0\0\0\1"
    default = drives.receive(BUS, speed)
    drives.receive(BUS, tmcl("01 05 04 00 00 00 00 32"))
    assert drives.receive(BUS, speed)[4:8] == b"\0\0\0\x32"
    drives.motor(LEG).reset()
    assert drives.receive(BUS, is_homed)[4:8] == b"\0\0\0\0"
    assert drives.receive(BUS, speed) == default


def test_a_tmcl_reference_search_is_active_until_the_switch_is_found() -> None:
    drives = some_drives(start_spread_m=1e-3, is_homed=False)
    status = tmcl("01 0d 02 00 00 00 00 00")
    assert drives.receive(BUS, tmcl("01 0d 00 00 00 00 00 00"))[2] == 100
    passed(drives, 0.2)
    assert drives.receive(BUS, status)[4:8] != b"\0\0\0\0"
    passed(drives, 60.0)
    assert drives.receive(BUS, status)[4:8] == b"\0\0\0\0"
    assert drives.motor(LEG).true_spindle_steps == 0


# --- Zaber


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"/1 1 get pos\r\n", b"@01 1 OK IDLE -- 0\r\n"),
        (b"/1 0 00 get pos:2D\r\n", b"@01 0 00 OK IDLE -- 0"),  # as zaber-motion sends it
        (b"/1 2 get pos\n", b"@01 2 RJ IDLE -- BADAXIS\r\n"),
        (b"/1 1 get nonsense\n", b"@01 1 RJ IDLE -- BADCOMMAND\r\n"),
        (b"/1 1 fly away\n", b"@01 1 RJ IDLE -- BADCOMMAND\r\n"),
        (b"/1 1 move abs x\n", b"@01 1 RJ IDLE -- BADDATA\r\n"),
        (b"/1 1 move abs 3334\n", b"@01 1 RJ IDLE -- BADDATA\r\n"),  # 10 mm are 3333 steps
        (b"/1 1 set maxspeed 0\n", b"@01 1 RJ IDLE -- BADDATA\r\n"),
        (b"/1 1 get system.serial\n", b"@01 1 RJ IDLE -- DEVICEONLY\r\n"),
        (b"/1 0 get system.serial\n", b"@01 0 OK IDLE -- 52001\r\n"),
        (b"/1 1 move abs 300\n", b"@01 1 OK BUSY -- 0\r\n"),
        (b"/1 1 warnings\n", b"@01 1 OK IDLE -- 00\r\n"),
        (b"/1 1 get driver.temperature\n", b"@01 1 OK IDLE -- 10.0\r\n"),
        (b"/1 0 00 get pos:2E\r\n", b""),  # a wrong check sum: silence
        (b"get pos\n", b""),
    ],
)
def test_a_zaber_device_answers_as_its_manual_says(command: bytes, answer: bytes) -> None:
    given = some_drives("zaber").receive(BUS, command)
    assert given.startswith(answer) if answer else given == b""


def test_all_zaber_devices_answer_to_device_0() -> None:
    answers = some_drives("zaber").receive(BUS, b"/get pos\n").splitlines()
    assert answers == [b"@01 0 OK IDLE -- 0", b"@02 0 OK IDLE -- 0", b"@03 0 OK IDLE -- 0"]


def test_a_zaber_device_that_was_reset_flags_its_lost_reference_until_homed() -> None:
    drives = some_drives("zaber")
    drives.motor(LEG).reset()
    assert drives.receive(BUS, b"/1 1 get pos\n") == b"@01 1 OK IDLE WR 0\r\n"
    drives.receive(BUS, b"/1 1 home\n")
    passed(drives, 60.0)
    assert drives.receive(BUS, b"/1 1 get pos\n") == b"@01 1 OK IDLE -- 0\r\n"


# --- Modbus


@pytest.mark.parametrize(
    ("request_hex", "answer_hex"),
    [
        ("01 03 10 03 00 01", "01 03 02 00 42"),  # status: enabled, homed
        ("01 03 77 77 00 01", "01 83 02"),  # no such address
        ("01 03 10 03 00 7e", "01 83 03"),  # 126 registers
        ("01 06 10 03 00 01", "01 86 02"),  # read only
        ("01 06 62 03 27 10", "01 86 03"),  # a speed it cannot reach
        ("01 05 00 00 ff 00", "01 85 01"),  # coils: no such function
        ("01 10 62 01 00 01 02 00 00", "01 90 02"),  # half of a position
        ("01 10 62 01 00 02 04 00 00 01 2c", "01 10 62 01 00 02"),
    ],
)
def test_a_modbus_drive_answers_as_the_standard_says(request_hex: str, answer_hex: str) -> None:
    assert some_drives("modbus_rtu").receive(BUS, rtu(request_hex)) == rtu(answer_hex)
    request, answer = bytes.fromhex(request_hex), bytes.fromhex(answer_hex)
    head = b"\x12\x34\0\0"
    framed = some_drives("modbus_tcp").receive(BUS, head + struct.pack(">H", len(request)) + request)
    assert framed == head + struct.pack(">H", len(answer)) + answer


def test_a_modbus_frame_with_a_wrong_sum_gets_no_answer_and_the_next_one_does() -> None:
    drives = some_drives("modbus_rtu")
    good = rtu("01 03 10 03 00 01")
    assert drives.receive(BUS, good[:-1] + bytes([good[-1] ^ 4])) == b""
    assert drives.receive(BUS, good) == rtu("01 03 02 00 42")


def test_a_modbus_broadcast_stops_all_drives_and_none_answers() -> None:
    drives = some_drives("modbus_rtu")
    for unit in ("01", "02"):
        drives.receive(BUS, rtu(f"{unit} 10 62 01 00 02 04 00 00 03 e8"))
        drives.receive(BUS, rtu(f"{unit} 06 62 00 00 01"))
        drives.receive(BUS, rtu(f"{unit} 06 60 02 00 10"))
    passed(drives, 1.0)
    assert drives.receive(BUS, rtu("00 06 60 02 00 40")) == b""
    passed(drives, 0.3)
    for leg in (0, 1):
        motor = drives.motor(Leg(7, leg))
        assert not motor.is_moving
        assert 100 < motor.count < 900


def test_a_pulse_stepper_moves_when_it_is_triggered() -> None:
    drives = some_drives("modbus_rtu")
    drives.receive(BUS, rtu("01 10 62 01 00 02 04 00 00 01 2c"))
    drives.receive(BUS, rtu("01 06 62 00 00 01"))
    assert not drives.motor(LEG).is_moving
    drives.receive(BUS, rtu("01 06 60 02 00 10"))
    assert drives.receive(BUS, rtu("01 03 10 03 00 01")) == rtu("01 03 02 00 46")  # running
    passed(drives, 5.0)
    assert drives.receive(BUS, rtu("01 03 60 2c 00 02")) == rtu("01 03 04 00 00 01 2c")


def test_a_two_register_actuator_knows_its_place_after_a_reset() -> None:
    """+0.9 mm is 20900 um of its stroke."""
    drives = some_drives("modbus_rtu", map_name="two_register")
    drives.receive(BUS, rtu("01 06 00 00 51 a4"))
    passed(drives, 5.0)
    drives.motor(LEG).reset()
    assert drives.receive(BUS, rtu("01 04 00 00 00 01")) == rtu("01 04 02 51 a4")
    assert drives.receive(BUS, rtu("01 03 00 00 00 01")) == rtu("01 03 02 51 a4")
    assert drives.receive(BUS, rtu("01 06 00 00 ff ff")) == rtu("01 86 03")  # beyond its stroke


def test_a_cia402_drive_goes_through_its_states() -> None:
    """Statuswords of the profile, masked: disabled, ready, switched on, enabled, quick stop, disabled."""
    drives = some_drives(map_name="cia402", protocol="modbus_rtu")
    the_map = register_map("cia402")
    unit = Cia402Unit(1, the_map, drives.motor(LEG))

    def write(name: str, raw: int) -> None:
        register = the_map.registers[name]
        unit.write(16, register.address, register.encode_raw(raw))

    def status() -> int:
        register = the_map.registers["statusword"]
        return int(register.decode_raw(unit.read(3, register.address, register.count)))

    seen = []
    for control in (0x00, 0x0F, 0x06, 0x07, 0x0F):
        write("controlword", control)
        seen.append(status() & 0x6F)
    assert seen == [0x40, 0x40, 0x21, 0x23, 0x27]
    write("mode", 1)
    write("target_position", -600)
    write("controlword", 0x1F)
    assert status() & 0x1400 == 0x1000  # set-point acknowledged, target not reached
    drives.motor(LEG).update(1.0)
    write("controlword", 0x02)
    assert status() & 0x046F == 0x07
    drives.motor(LEG).update(2.0)
    assert status() & 0x046F == 0x07 | 0x0400
    count = drives.motor(LEG).count
    assert -600 < count < 0
    write("controlword", 0x0F)
    assert status() & 0x6F == 0x07  # a quick stop is left through "disabled"
    drives.motor(LEG).reset()
    assert status() & 0x804F == 0x40  # disabled and not homed


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_two_drives_with_one_address_both_act(protocol: str) -> None:
    drives = some_drives(protocol)
    drives.inject(FaultSpec("same_address", 0.0, None, {"facet": 7, "leg": 2, "other_facet": 7, "other_leg": 1}))
    orders = {
        "tmcl": [tmcl("01 04 00 00 00 00 01 2c")],
        "zaber": [b"/1 1 move abs 300\n"],
        "modbus_rtu": [
            rtu(f"01 {rest}") for rest in ("10 62 01 00 02 04 00 00 01 2c", "06 62 00 00 01", "06 60 02 00 10")
        ],
        "modbus_tcp": [
            bytes.fromhex(text)
            for text in (
                "0001 0000 000b 01 10 6201 0002 04 0000 012c",
                "0001 0000 0006 01 06 6200 0001",
                "0001 0000 0006 01 06 6002 0010",
            )
        ],
    }
    for order in orders[protocol]:
        drives.receive(BUS, order)
    passed(drives, 5.0)
    assert [drives.motor(Leg(7, leg)).true_spindle_steps for leg in range(3)] == [300, 300, 0]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@given(soup=st.binary(max_size=120), cut=st.integers(0, 120))
@settings(max_examples=40, deadline=None)
def test_no_soup_of_bytes_upsets_a_bus(protocol: str, soup: bytes, cut: int) -> None:
    drives = some_drives(protocol, n_legs=1)
    drives.receive(BUS, soup[:cut])
    drives.receive(BUS, soup[cut:])
    question = {
        "tmcl": tmcl("01 06 01 00 00 00 00 00"),
        "zaber": b"\n/1 1 get pos\n",
        "modbus_rtu": rtu("01 03 10 03 00 01"),
        "modbus_tcp": bytes.fromhex("0001 0000 0006 01 03 1003 0001"),
    }[protocol]
    # What it takes for the rest of a damaged frame may cost the next questions, but not for ever.
    assert any(drives.receive(BUS, question) for _ in range(60))
