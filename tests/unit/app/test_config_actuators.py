"""The section `[actuators]` of an instrument's config: what it means, and what it refuses."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from namod_ctl.app import cli
from namod_ctl.app.build.actuators import build_bus_settings, build_motion_settings
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, load_config
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.devices.buses import DriveSettings

ACTUATORS = """\
[actuators]
step_um = 3.0
sign = -1
range_mm = [-4.0, 5.0]
speed_mm_per_s = 0.8
acceleration_mm_per_s2 = 4.0

[actuators.motion]
max_travel_per_cycle_mm = 3.0
approach_mm = 0.04
arrival_tolerance_um = 9.0
settle_s = 0.2
poll_s = 0.1

[[actuators.buses]]
name = "east"
url = "/dev/ttyUSB7"
protocol = "tmcl"
baud = 57600
timeout_s = 0.05
retries = 2
has_echo = true
turnaround_s = 0.002
max_moving = 6
facet_ids = [13, 31]
first_address = 5
axes_per_address = 3
wires = [{ facet = 31, leg = 2, address = 40, axis = 4, sign = 1 }]

[[actuators.buses]]
name = "west"
url = "socket://192.0.2.7:502"
protocol = "modbus_tcp"
drive_map = "pulse_stepper"
max_moving = 4
facet_ids = [10]
"""
HEAD = 'extends = "fact"\n\n[mount]\nbacklash_um = 10.0\n\n'
KEYS = [
    line.split(" = ")[0]
    for line in ACTUATORS.split('\n\n[[actuators.buses]]\nname = "west"')[0].splitlines()
    if " = " in line
]
REQUIRED = {
    "step_um": r"buses\[1\]: its drives count steps, but actuators.step_um is missing",
    "range_mm": r"actuators.range_mm: this key is missing; add it, in mm",
    "speed_mm_per_s": r"actuators.speed_mm_per_s: this key is missing; add it, in mm per s",
    "acceleration_mm_per_s2": r"actuators.acceleration_mm_per_s2: this key is missing; add it, in mm per s2",
    "name": r"actuators.buses\[1\].name: this key is missing",
    "url": r"actuators.buses\[1\].url: this key is missing",
    "protocol": r"actuators.buses\[1\].protocol: this key is missing",
    "max_moving": r"actuators.buses\[1\].max_moving: this key is missing",
    "facet_ids": r"facet 31 has no drive for leg 1 and 3 of its 3 legs; wire all of them or none",
}
DEFAULTS: dict[str, Callable[[InstrumentConfig], bool]] = {
    "sign": lambda config: drives_of(config)[Leg(13, 0)].steps_per_m > 0.0,
    # FACT's mount says 5 mm
    "max_travel_per_cycle_mm": lambda config: (
        build_motion_settings(config).max_travel_per_cycle_m == pytest.approx(5e-3)
    ),
    "approach_mm": lambda config: build_motion_settings(config).approach_m == pytest.approx(50e-6),
    "arrival_tolerance_um": lambda config: (
        build_motion_settings(config).arrival_tolerance_m == pytest.approx(6e-6)
    ),  # two steps
    "settle_s": lambda config: build_motion_settings(config).settle_s == 0.1,
    "poll_s": lambda config: build_motion_settings(config).poll_s == 0.05,
    "baud": lambda config: build_bus_settings(config)[0].baud == 9600,  # of a new TMCL module
    "timeout_s": lambda config: build_bus_settings(config)[0].line.timeout_s == 0.1,
    "retries": lambda config: build_bus_settings(config)[0].line.n_retries == 3,
    "has_echo": lambda config: not build_bus_settings(config)[0].line.has_echo,
    "turnaround_s": lambda config: build_bus_settings(config)[0].line.turnaround_s == 0.0,
    "first_address": lambda config: drives_of(config)[Leg(13, 0)].address == 1,
    "axes_per_address": lambda config: [drives_of(config)[Leg(13, i)].address for i in range(3)] == [5, 6, 7],
    "wires": lambda config: (drives_of(config)[Leg(31, 1)].address, drives_of(config)[Leg(31, 1)].axis) == (6, 1),
}


def drives_of(config: InstrumentConfig) -> dict[Leg, DriveSettings]:
    return {drive.leg: drive for bus in build_bus_settings(config) for drive in bus.drives}


def load(folder: Path, text: str = ACTUATORS, head: str = HEAD) -> InstrumentConfig:
    (folder / "it.toml").write_text(head + text)
    return load_config(folder / "it.toml")


def refusal(folder: Path, text: str, head: str = HEAD) -> str:
    with pytest.raises(ConfigError) as refused:
        load(folder, text, head)
    for line in str(refused.value).splitlines():
        assert line.startswith(str(folder / "it.toml")), "every problem names the file"
    return str(refused.value)


def changed(*changes: tuple[str, str]) -> str:
    text = ACTUATORS
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def test_what_is_written_is_what_the_drives_get_in_si_units(tmp_path: Path) -> None:
    config = load(tmp_path)
    east, west = build_bus_settings(config)
    assert (east.name, east.url, east.protocol, east.baud, east.max_moving) == (
        "east",
        "/dev/ttyUSB7",
        "tmcl",
        57600,
        6,
    )
    assert (east.line.timeout_s, east.line.n_retries, east.line.has_echo, east.line.turnaround_s) == (
        0.05,
        2,
        True,
        0.002,
    )
    assert east.range_m == pytest.approx((-4e-3, 5e-3))
    assert (east.speed_m_per_s, east.acceleration_m_per_s2) == pytest.approx((0.8e-3, 4e-3))
    drives = drives_of(config)
    places = {leg: (drive.address, drive.axis) for leg, drive in drives.items()}
    assert places == {
        Leg(13, 0): (5, 0),
        Leg(13, 1): (5, 1),
        Leg(13, 2): (5, 2),
        Leg(31, 0): (6, 0),
        Leg(31, 1): (40, 4),  # written out; the rule's other places stay as they were
        Leg(31, 2): (6, 2),
        Leg(10, 0): (1, 0),
        Leg(10, 1): (2, 0),
        Leg(10, 2): (3, 0),
    }
    assert drives[Leg(13, 0)].steps_per_m == pytest.approx(-1.0 / 3e-6)
    assert drives[Leg(31, 1)].steps_per_m == pytest.approx(1.0 / 3e-6)
    assert west.register_map is not None
    assert west.register_map.position_unit == "steps"
    assert build_motion_settings(config) == MotionSettings(
        max_travel_per_cycle_m=pytest.approx(3e-3),
        approach_m=pytest.approx(40e-6),
        arrival_tolerance_m=pytest.approx(9e-6),
        settle_s=0.2,
        poll_s=0.1,
        speed_m_per_s=pytest.approx(0.8e-3),
    )


def test_every_key_is_either_required_or_has_a_known_default() -> None:
    assert set(KEYS) == REQUIRED.keys() | DEFAULTS.keys()


@pytest.mark.parametrize("key", KEYS)
def test_without_a_key_it_is_refused_or_has_its_default(key: str, tmp_path: Path) -> None:
    text, n = re.subn(rf"^{key} = .*\n", "", ACTUATORS, count=1, flags=re.MULTILINE)
    assert n == 1
    if key in REQUIRED:
        assert re.search(REQUIRED[key], refusal(tmp_path, text))
    else:
        assert DEFAULTS[key](load(tmp_path, text))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "range_mm = [-4.0, 5.0]",
            "range_mm = [5.0, -4.0]",
            "actuators.range_mm = [5, -4] is inside out: the first must be below",
        ),
        ("range_mm = [-4.0, 5.0]", "range_mm = [1.0, 1.0]", "actuators.range_mm = [1, 1] is inside out"),
        ("range_mm = [-4.0, 5.0]", "range_mm = [-4000.0, 5.0]", "-4000.0 is not plausible, must be at least -200 mm"),
        (
            "range_mm = [-4.0, 5.0]",
            "range_m = [-4e-3, 5e-3]",
            "this value is expected in mm: convert it and write range_mm",
        ),
        (
            "step_um = 3.0",
            "step_mm = 0.003",
            "actuators.step_mm: is in mm (value 0.003), but this value is expected in um",
        ),
        ("step_um = 3.0", "step_um = 0.0", "actuators.step_um = 0.0 is not plausible, must be at least 0.0001 um"),
        ("sign = -1", "sign = 0", "actuators.sign = 0 does not fit"),
        ("poll_s = 0.1", "polls_s = 0.1", "actuators.motion.polls_s: unknown key (value 0.1); did you mean poll_s?"),
        ("retries = 2", "n_retries = 2", "actuators.buses[1].n_retries: unknown key"),
        ("baud = 57600", "baud = 57600.5", "actuators.buses[1].baud = 57600.5 does not fit"),
        ('"tmcl"', '"canopen"', "actuators.buses[1].protocol = 'canopen' does not fit"),
        ('"/dev/ttyUSB7"', '"http://host"', "'http://host' names no line; write one of /dev/ttyUSB0, COM3, socket://"),
        ('"/dev/ttyUSB7"', '"socket://host"', "'socket://host' names no line"),
        ('"/dev/ttyUSB7"', '"rfc2217://host:99999"', "'rfc2217://host:99999' names no line"),
        ('"/dev/ttyUSB7"', '"dev/ttyUSB7"', "'dev/ttyUSB7' names no line"),
        ('"/dev/ttyUSB7"', '"loopback://"', "'loopback://' names no line"),
        ("socket://192.0.2.7:502", "/dev/ttyUSB8", 'is no TCP line, but protocol = "modbus_tcp"'),
        ("socket://192.0.2.7:502", "/dev/ttyUSB7", "is no TCP line"),
        ('drive_map = "pulse_stepper"', "", 'this bus has protocol = "modbus_tcp" and no drive_map'),
        ('protocol = "modbus_tcp"', 'protocol = "zaber"', 'this bus has protocol = "zaber" and a drive_map'),
        (
            '"pulse_stepper"',
            '"no_such_map"',
            "buses[2].drive_map: .*no_such_map: no readable register map .*built-in name: cia402",
        ),
        ("facet_ids = [10]", "", "actuators.buses[2]: wires no leg: give facet_ids, or wires, or both"),
        (
            "facet_ids = [10]",
            "facet_ids = [14]",
            "actuators.buses[2].facet_ids: there is no facet 14; the reflector has 0, 2,",
        ),
        (
            "facet_ids = [10]",
            "facet_ids = [13]",
            "facet 13 leg 1, 2, 3: wired 2 times (east, west); every leg has one drive",
        ),
        ("facet_ids = [10]", "facet_ids = [10, 10]", "facet 10 leg 1, 2, 3: wired 2 times (west, west)"),
        (
            "facet_ids = [10]",
            "wires = [{ facet = 10, leg = 1, address = 1 }]",
            "facet 10 has no drive for leg 2 and 3 of its 3",
        ),
        ("facet = 31, leg = 2", "facet = 8, leg = 2", "actuators.buses[1].wires: there is no facet 8"),
        (
            "facet = 31, leg = 2",
            "facet = 31, leg = 4",
            "buses[1].wires[1].leg = 4: the mount of facet 31 has legs 1 to 3",
        ),
        (
            "address = 40, axis = 4",
            "address = 5, axis = 1",
            "address 5, axis 1 is that of facet 13 leg 2 and of facet 31 leg 2;",
        ),
        ("address = 40, axis = 4", "address = 40, axis = 6", "facet 31 leg 2 has axis = 6, protocol tmcl has 0 to 5"),
        ("first_address = 5", "first_address = 255", "addresses 256 do not exist, protocol tmcl has 1 to 255"),
        (
            "axes_per_address = 3",
            "axes_per_address = 7",
            'axes_per_address = 7, must be at most 6 for protocol = "tmcl"',
        ),
        (
            'name = "west"',
            'name = "east"',
            "buses[2].name = 'east' is also that of actuators.buses[1]; every bus needs its own",
        ),
        ('name = "west"', 'name = "../west"', "actuators.buses[2].name = '../west' does not fit"),
        (
            "max_travel_per_cycle_mm = 3.0",
            "max_travel_per_cycle_mm = 6.0",
            "= 6 is more than mount.travel_limit_mm = 5; lower it",
        ),
        (
            "approach_mm = 0.04",
            "approach_mm = 0.009",
            "approach_mm = 0.009 is less than mount.backlash_um = 10: the approach",
        ),
        ("arrival_tolerance_um = 9.0", "arrival_tolerance_um = 2.0", "arrival_tolerance_um = 2 is less than 0.003 mm"),
        (
            '"pulse_stepper"',
            '"two_register"\nbaud = 1',
            "actuators.buses[2].baud = 1 is not plausible, must be at least 300",
        ),
    ],
)
def test_a_contradiction_is_refused_with_key_value_rule_and_remedy(
    old: str, new: str, says: str, tmp_path: Path
) -> None:
    message = refusal(tmp_path, changed((old, new)))
    pattern = re.escape(says).replace(r"\.\*", ".*")
    assert re.search(pattern, message), message


def test_actuators_without_a_bus_are_refused(tmp_path: Path) -> None:
    limits = ACTUATORS[: ACTUATORS.index("[actuators.motion]")]
    assert "actuators.buses: this key is missing; add it" in refusal(tmp_path, limits)
    assert "actuators.buses: there is no bus; add [[actuators.buses]]" in refusal(tmp_path, limits + "buses = []\n")


def test_all_problems_are_told_together(tmp_path: Path) -> None:
    text = changed(
        ("facet_ids = [10]", "facet_ids = [10, 14]"),
        ("address = 40, axis = 4", "address = 5, axis = 1"),
        ("approach_mm = 0.04", "approach_mm = 0.001"),
        ("max_travel_per_cycle_mm = 3.0", "max_travel_per_cycle_mm = 60.0"),
    )
    assert len(refusal(tmp_path, text).splitlines()) == 4
    text = changed(
        ("range_mm = [-4.0, 5.0]", "range_mm = [5.0, -4.0]"),
        ("sign = -1", "sign = 2"),
        ("poll_s", "pol_s"),
        ("/dev/ttyUSB7", "ttyUSB7"),
        ("socket://192.0.2.7:502", "/dev/ttyUSB8"),
    )
    assert len(refusal(tmp_path, text).splitlines()) == 5


def test_kinematics_that_leave_a_motion_free_are_refused(tmp_path: Path) -> None:
    mount = """
[mount]
kind = "legs"
positions_m = [[-0.3, 0.0], [0.3, 0.0]]
has_fixed_point = true
orientation_deg = 0.0
travel_limit_mm = 5.0
goniometer_resolution_deg = 5.0
backlash_um = 10.0
"""
    text = changed(("wires = [{ facet = 31, leg = 2, address = 40, axis = 4, sign = 1 }]", ""))
    assert "the legs leave a motion of the facet free" in refusal(tmp_path, text, 'extends = "fact"\n' + mount)
    two = build_bus_settings(load(tmp_path, text, 'extends = "fact"\n' + mount.replace("[0.3, 0.0]", "[0.3, 0.2]")))
    assert [drive.leg for drive in two[0].drives] == [Leg(13, 0), Leg(13, 1), Leg(31, 0), Leg(31, 1)]


def test_a_register_map_with_overlapping_registers_is_refused(tmp_path: Path) -> None:
    good = (builtin_folder() / "drives" / "pulse_stepper.toml").read_text()
    bad = good.replace("position = { address = 0x602C", "position = { address = 0x6202", 1)
    assert bad != good
    (tmp_path / "mine.toml").write_text(bad)
    message = refusal(tmp_path, changed(('"pulse_stepper"', '"mine.toml"')))
    assert "actuators.buses[2].drive_map" in message
    assert "record_position" in message
    assert "overlap" in message


def test_limits_beyond_what_the_drives_can_express_are_refused(tmp_path: Path) -> None:
    text = changed(('"pulse_stepper"', '"two_register"'), ("range_mm = [-4.0, 5.0]", "range_mm = [-4.0, 25.0]"))
    message = refusal(tmp_path, text)
    assert "actuators.buses[2]: Modbus unit 1" in message
    assert "range_m" in message


def test_step_um_is_needed_only_by_drives_that_count_steps(tmp_path: Path) -> None:
    west = ACTUATORS[ACTUATORS.index('[[actuators.buses]]\nname = "west"') :].replace("pulse_stepper", "two_register")
    limits = "[actuators]\nrange_mm = [-4.0, 5.0]\nspeed_mm_per_s = 1.0\nacceleration_mm_per_s2 = 4.0\n"
    config = load(tmp_path, limits + west)
    assert [drive.steps_per_m for drive in drives_of(config).values()] == pytest.approx([1e6] * 3)
    # one count of rounding and the two that the map allows a standing actuator, twice
    assert build_motion_settings(config).arrival_tolerance_m == pytest.approx(6e-6)


def test_the_stored_config_needs_no_other_file(tmp_path: Path) -> None:
    shutil.copy(builtin_folder() / "drives" / "pulse_stepper.toml", tmp_path / "mine.toml")
    config = load(tmp_path, changed(('"pulse_stepper"', '"mine.toml"')))
    for path in tmp_path.iterdir():
        path.unlink()
    restored = InstrumentConfig.from_json(config.to_json(), "stored")
    assert restored == config
    assert build_bus_settings(restored) == build_bus_settings(config)
    with pytest.raises(ConfigError, match="must hold its register maps written out"):
        InstrumentConfig.from_json(
            re.sub(r'"drive_map": \{.*?\n    \}', '"drive_map": "cia402"', config.to_json(), flags=re.S), "x"
        )


def test_without_the_section_there_is_nothing_to_move() -> None:
    config = load_config("fact")
    assert "actuators" not in config.to_json()
    with pytest.raises(ConfigError, match=r"FACT: the config has no \[actuators\]"):
        build_bus_settings(config)


def test_config_check_tells_the_drives_and_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    load(tmp_path, changed(("approach_mm = 0.04", "approach_mm = 0.0"), ("/dev/ttyUSB7", "loopback://a")))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["namod-ctl", "config", "check", str(tmp_path / "it.toml")])
    with pytest.raises(SystemExit) as done:
        cli.main()
    assert done.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for expected in (
        "9 on 2 buses, for 3 of 30 facets",
        "moves a leg away from the sky",
        "-4 to 5 mm from the reference",
        "TMCL on loopback://a at 57600 baud: 6 drives, addresses 5, 6, 40, axes 0 to 2, 4; at most 6 at once",
        "Modbus TCP (pulse-count stepper drive) on socket://192.0.2.7:502: 3 drives, addresses 1 to 3;",
        "warning: facets without drives, which stay as they are: 0, 2 to 7",
        "warning: legs have a play of 10 um and are not approached from one side",
        "warning: buses in memory, for the twin only (loopback://): east",
    ):
        assert expected in text, expected
