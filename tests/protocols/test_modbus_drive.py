"""Register maps: values <-> registers, bits and sequences, and what is refused before a drive is spoken to."""

from __future__ import annotations

import copy
import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError
from firmware_protocols.modbus_drive import TYPES, WORD_ORDERS, Register, RegisterImage, RegisterMap
from firmware_protocols.modbus_map import RegisterMapError, read_register_map

DRIVES = Path(__file__).parents[2] / "config" / "drives"
NAMES = ("cia402", "pulse_stepper", "two_register")
RANGES = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
}
WORDS = st.integers(0, 0xFFFF)


def file_of(name: str) -> dict[str, Any]:
    return tomllib.loads((DRIVES / f"{name}.toml").read_text())


def map_of(name: str) -> RegisterMap:
    return read_register_map(file_of(name))


def register(type_: str, word_order: str = "high_first", **keys: Any) -> Register:
    return Register("r", 100, type_, word_order, read=3, write=16, **keys)


@pytest.mark.parametrize(
    ("type_", "word_order", "raw", "words"),
    [
        # two's complement and big-endian words: MODBUS Application Protocol V1.1b3, section 4.2
        ("uint16", "high_first", 0x1234, (0x1234,)),
        ("int16", "high_first", -2, (0xFFFE,)),
        ("int32", "high_first", -123456, (0xFFFE, 0x1DC0)),
        ("int32", "low_first", -123456, (0x1DC0, 0xFFFE)),
        ("uint32", "high_first", 0x12345678, (0x1234, 0x5678)),
        ("uint32", "low_first", 0x12345678, (0x5678, 0x1234)),
        # IEEE 754: 1.0 = 0x3F800000; -118.625 = 0xC2ED4000 (the worked example of many text books)
        ("float32", "high_first", 1.0, (0x3F80, 0x0000)),
        ("float32", "high_first", -118.625, (0xC2ED, 0x4000)),
        ("float32", "low_first", -118.625, (0x4000, 0xC2ED)),
    ],
)
def test_raw_values_and_words(type_: str, word_order: str, raw: float, words: tuple[int, ...]) -> None:
    assert register(type_, word_order).encode_raw(raw) == words
    assert register(type_, word_order).decode_raw(words) == raw


@given(st.sampled_from(sorted(RANGES)), st.sampled_from(WORD_ORDERS), st.data())
def test_every_whole_number_of_a_type_survives(type_: str, word_order: str, data: st.DataObject) -> None:
    raw = data.draw(st.integers(*RANGES[type_]))
    assert register(type_, word_order).decode_raw(register(type_, word_order).encode_raw(raw)) == raw


@pytest.mark.parametrize("type_", sorted(RANGES))
def test_numbers_beyond_a_type_are_our_fault(type_: str) -> None:
    low, high = RANGES[type_]
    for raw in (low - 1, high + 1, 0.5, math.nan, math.inf):
        with pytest.raises(LocalProtocolError, match="does not fit its type"):
            register(type_).encode_raw(raw)


def test_a_float_too_large_is_our_fault() -> None:
    with pytest.raises(LocalProtocolError):
        register("float32").encode_raw(1e39)


@given(st.sampled_from(sorted(TYPES)), st.sampled_from(WORD_ORDERS), st.lists(st.integers(-2, 0x10001), max_size=4))
def test_register_soup_is_read_or_is_the_peers_fault(type_: str, word_order: str, words: list[int]) -> None:
    soup = register(type_, word_order)
    try:
        raw = soup.decode_raw(words)
    except RemoteProtocolError:
        return
    assert math.isfinite(raw)
    assert soup.encode_raw(raw) == tuple(words)


@given(st.floats(-0.02, 0.02))
def test_a_position_in_metres_is_rounded_to_the_nearest_count(position_m: float) -> None:
    target = map_of("two_register").registers["target"]
    assert abs(target.decode(target.encode(position_m)) - position_m) <= 0.5e-6 * (1 + 1e-9)  # counts of 1 um


def test_values_are_raw_times_scale_plus_offset() -> None:
    registers = map_of("cia402").registers
    assert registers["temperature"].decode((0, 25)) == pytest.approx(298.15)  # 25 deg C in K
    assert map_of("pulse_stepper").registers["record_speed"].decode((60,)) == pytest.approx(1000.0)  # 60 rpm, 1000/turn


@pytest.mark.parametrize("name", NAMES)
def test_maps_of_the_program_are_sound(name: str) -> None:
    register_map = map_of(name)
    assert register_map.has_homing == (name != "two_register")
    assert register_map.registers[register_map.position].unit == register_map.position_unit


def test_states_of_cia_402() -> None:
    """Statuswords of the standard's table of states (IEC 61800-7-201, statusword bits 0, 1, 2, 3, 5, 6)."""
    conditions = map_of("cia402").conditions
    table = {"disabled": 0x0240, "ready": 0x0231, "switched_on": 0x0233, "enabled": 0x0237, "fault": 0x0218}
    for state, word in table.items():
        raws = {"statusword": word, "mode_display": 1}
        assert [name for name in table if conditions[name].holds(raws)] == [state]
    quick_stop = {"statusword": 0x0217, "mode_display": 1}
    assert not any(conditions[name].holds(quick_stop) for name in table)
    assert conditions["moving"].holds(quick_stop)


@pytest.mark.parametrize("name", NAMES)
def test_a_read_takes_each_quantity_whole_and_nothing_that_is_not_there(name: str) -> None:
    register_map = map_of(name)
    image = RegisterImage(register_map)
    readable = {name for name, register in register_map.registers.items() if register.read is not None}
    raws: dict[str, float] = {}
    for index, register_name in enumerate(sorted(readable)):
        image[register_name] = index + 1
    for block in register_map.reads(readable):
        raws |= register_map.decode_block(block, image.read(block.function, block.address, block.count))
    assert raws == {name: index + 1 for index, name in enumerate(sorted(readable))}
    with pytest.raises(RemoteProtocolError):
        register_map.decode_block(block, (0,) * (block.count + 1))


def test_status_of_a_cia_402_drive_is_one_request() -> None:
    assert len(map_of("cia402").reads(["statusword", "mode_display"])) == 1


@given(function=st.sampled_from([3, 4, 6, 16, 5]), address=st.integers(0, 0xFFFF), words=st.lists(WORDS, max_size=6))
def test_a_server_takes_or_refuses_any_write_as_a_whole(function: int, address: int, words: list[int]) -> None:
    register_map = map_of("cia402")
    image = RegisterImage(register_map)
    before = {name: image[name] for name in register_map.registers}
    try:
        names = image.write(function, address, words)
    except RemoteProtocolError:
        assert {name: image[name] for name in register_map.registers} == before
        return
    assert sum(register_map.registers[name].count for name in names) == len(words)


def test_half_of_a_32_bit_value_is_refused() -> None:
    image = RegisterImage(map_of("cia402"))
    for address, words in ((6940, (1,)), (6941, (1,)), (6939, (1, 2)), (6941, (1, 2))):
        with pytest.raises(RemoteProtocolError):
            image.write(16, address, words)
    assert image.write(16, 6940, (0xFFFF, 0xFF9C)) == ("target_position",)
    assert image["target_position"] == -100


def broken(name: str, *path: str | int, value: Any) -> str:
    """The problems of a map with one value replaced."""
    raw = file_of(name)
    inner = raw
    for key in path[:-1]:
        inner = inner[key]  # type: ignore[index]
    inner[path[-1]] = value  # type: ignore[index]
    with pytest.raises(RegisterMapError) as caught:
        read_register_map(raw)
    return str(caught.value)


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        (("registers", "mode", "address"), 6915, r"registers.controlword and registers.mode overlap at address 6915"),
        (("registers", "position_actual", "address"), 7201, "overlap at address 7201"),
        (("registers", "mode", "address"), 0x10000, "0 to 65535"),
        (("registers", "position_actual", "type"), "int64", "'int64' is none of 'int16'"),
        (("registers", "position_actual", "scale"), 0, "position_actual.scale: must not be 0"),
        (("registers", "position_actual", "scale"), math.nan, "position_actual.scale: nan"),
        (("registers", "position_actual", "word_order"), "little", "'high_first', 'low_first'"),
        (("registers", "position_actual", "read"), 2, "none of the function codes 3 and 4"),
        (("registers", "position_actual", "unit"), "m", "roles.target: register target_position has unit 'steps'"),
        (("registers", "target_position", "write"), 6, "half-written int32 could start a move"),
        (("registers", "target_position", "writes"), 6, "target_position.writes: unknown"),
        (("registers", "product_code"), 5, "registers.product_code: must be a table"),
        (("roles", "position"), "posiiton", "roles.position: there is no register 'posiiton'"),
        (("roles", "speed"), "temperature", "needs steps/s"),
        (("roles", "target"), "position_actual", "must be writable"),
        (("status", "moving", "all"), [], "status.moving: needs all"),
        (("status", "homed", "all", 0, "mask"), 0, "status.homed.all"),
        (("status", "moving", "all", 0, "value"), 0x0008, "bits outside of mask"),
        (("status", "homed", "all", 0, "register"), "position_actual", "must be a readable uint16 or uint32"),
        (("sequences", "stop"), [{"write": "controlword", "value": -1}], "does not fit its type"),
        (("sequences", "stop"), [{"write": "statusword", "value": 1}], "must be writable"),
        (("sequences", "move"), [{"write": "controlword", "value": 63}], 'must write value = "target" once'),
        (("sequences", "home", 0, "unless"), "awake", "there is no status.awake"),
        (("sequences", "home", 0, "run"), "move", "runs another one itself"),
        (("sequences", "home", 3, "timeout_s"), 1e9, "0 to 60"),
        (("fault_codes", "texts"), {"E17": "hot"}, "must be a number such as 0x2310"),
    ],
)
def test_what_is_refused(path: tuple[str | int, ...], value: Any, problem: str) -> None:
    text = broken("cia402", *path, value=value)
    assert problem.replace("\\", "") in text


def test_all_problems_are_told_together() -> None:
    raw = file_of("cia402")
    raw["registers"]["temperature"]["scale"] = 0
    raw["registers"]["mode"]["type"] = "word"
    del raw["roles"]["target"]
    del raw["status"]["homed"]
    del raw["sequences"]["stop"]
    with pytest.raises(RegisterMapError) as caught:
        read_register_map(raw)
    assert len(caught.value.problems) == 5


@pytest.mark.parametrize("section", ["registers", "roles", "sequences", "name", "source"])
def test_no_section_may_be_missing(section: str) -> None:
    raw = file_of("cia402")
    del raw[section]
    with pytest.raises(RegisterMapError):
        read_register_map(raw)


def places(raw: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Paths to all values of a file, tables and lists included."""
    items = raw.items() if isinstance(raw, dict) else enumerate(raw) if isinstance(raw, list) else ()
    return [path, *(place for key, value in items for place in places(value, (*path, key)))]


JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3), st.just([]), st.just({}), st.just([{}])
)


@given(st.sampled_from(NAMES), st.data())
def test_any_nonsense_in_a_file_is_refused_in_words(name: str, data: st.DataObject) -> None:
    raw = copy.deepcopy(file_of(name))
    path = data.draw(st.sampled_from([place for place in places(raw) if place]))
    inner: Any = raw
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = data.draw(JUNK)
    try:
        register_map = read_register_map(raw)
    except RegisterMapError:
        return
    RegisterImage(register_map)
    register_map.reads(name for name, register in register_map.registers.items() if register.read is not None)
