"""From a config to drives that move: the production drivers on the lines of the twin, for every example config."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import serial  # type: ignore[import-untyped]

from namod_ctl.app import cli
from namod_ctl.app.build.actuators import build_bus_settings, open_actuators
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.build.twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_names, load_config
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.units import um_to_m
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drive_lines import DriveLine, PtyLine
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.settings import FaultSpec, TwinSettings

ACTUATED = [
    "bench_pylon",
    "fact_actuated",
    "fact_modbus_rtu",
    "fact_modbus_tcp",
    "fact_psf",
    "fact_zaber",
    "mst_actuated",
]
TRAVEL_M = 1e-3
LONG_S = 10.0  # to travel 1 mm at 1 mm/s

TWO_FACETS = """
extends = "fact_actuated"

[[actuators.buses]]
name = "south"
url = "{south}"
protocol = "tmcl"
max_moving = 2
timeout_s = 0.02
retries = 1
facet_ids = [0]
axes_per_address = 3

[[actuators.buses]]
name = "north"
url = "{north}"
protocol = "zaber"
max_moving = 2
timeout_s = 0.02
retries = 1
facet_ids = [13]
"""


def two_facets(folder: Path, south: str = "loopback://south", north: str = "/dev/ttyUSB9") -> InstrumentConfig:
    (folder / "two.toml").write_text(TWO_FACETS.format(south=south, north=north))
    return load_config(folder / "two.toml")


def twin_drives(config: InstrumentConfig, clock: ManualClock) -> TwinDrives:
    return TwinDrives(twin_wiring(config), clock, FaultPlan(), seed=3)


def test_these_are_the_configs_with_actuators() -> None:
    assert [name for name in builtin_names() if load_config(name).actuators is not None] == ACTUATED


@pytest.mark.parametrize("name", ACTUATED)
def test_a_leg_travels_as_it_is_told_and_no_other_does(name: str) -> None:
    config = load_config(name)
    clock = ManualClock()
    drives = twin_drives(config, clock)
    assert {leg.facet_id for leg in drives.legs} == {facet.id for facet in config.facets}
    with build_twin_actuators(config, drives) as buses:
        assert [bus.unreachable for bus in buses] == [{}] * len(buses)
        assert sorted(leg for bus in buses for leg in bus.drives) == sorted(drives.legs)
        moved = {}
        for bus in buses:
            leg, drive = list(bus.drives.items())[len(bus.drives) // 2]
            before = drive.state()
            assert before.is_homed
            assert not before.is_moving
            assert before.faults == ()
            drive.start_move(before.position_m + TRAVEL_M)
            assert drive.state().is_moving
            moved[leg] = (drive, before.position_m)
        clock.wait_s(LONG_S)
        for leg, (drive, start_m) in moved.items():
            after = drive.state()
            assert not after.is_moving
            assert abs(after.position_m - start_m - TRAVEL_M) <= drive.resolution_m
            # the play of 10 um may have to be taken up first
            lost_m = TRAVEL_M - drives.travel_m(leg)
            assert -drive.resolution_m <= lost_m <= um_to_m(config.mount.backlash_um) + 2.0 * drive.resolution_m
        assert all(drives.travel_m(leg) == 0.0 for leg in drives.legs if leg not in moved)


def test_the_lines_are_what_the_urls_ask_for(tmp_path: Path) -> None:
    kinds = {"loopback://here": "loopback://here", "/dev/ttyUSB3": "/", "socket://192.0.2.1:99": "socket://127.0.0.1:"}
    for url, begins in kinds.items():
        config = two_facets(tmp_path, south=url)
        clock = ManualClock()
        with build_twin_actuators(config, twin_drives(config, clock)) as buses:
            assert buses[0].name.startswith(f"south ({begins}")
            assert "192.0.2.1" not in buses[0].name
            assert "ttyUSB" not in buses[0].name
            assert buses[0].scan() == [
                "address 1 (facet 0 leg 1, facet 0 leg 2, facet 0 leg 3): TMCM-6110 firmware 1.21"
            ]
            assert [bus.max_moving for bus in buses] == [2, 2]


def test_a_reversed_leg_counts_down_and_still_travels_to_the_sky(tmp_path: Path) -> None:
    text = TWO_FACETS.format(south="loopback://a", north="loopback://b") + "\n[actuators]\nsign = -1\n"
    (tmp_path / "it.toml").write_text(text)
    config = load_config(tmp_path / "it.toml")
    clock = ManualClock()
    drives = twin_drives(config, clock)
    leg = Leg(13, 1)
    with build_twin_actuators(config, drives) as buses:
        count = drives.motor(leg).count
        drive = buses[1].drives[leg]
        assert drive.state().position_m == pytest.approx(count * -3e-6)
        drive.start_move(drive.state().position_m + TRAVEL_M)
        clock.wait_s(LONG_S)
        assert drives.motor(leg).count == pytest.approx(count - TRAVEL_M / 3e-6, abs=1.0)
        assert drives.travel_m(leg) == pytest.approx(TRAVEL_M, abs=16e-6)


def test_a_leg_that_travels_tilts_its_facet_in_the_twin() -> None:
    config = load_config("fact_actuated")
    twin = build_twin(config, TwinSettings(), 5, twin_wiring(config))
    before_rad = twin.true_tilt_rad
    with build_twin_actuators(config, twin.drives) as buses:
        drive = buses[1].drives[Leg(31, 0)]  # the arm at +x
        drive.start_move(drive.state().position_m + TRAVEL_M)
        twin.update(LONG_S)
    change_rad = twin.true_tilt_rad - before_rad
    row = [facet.id for facet in config.facets].index(31)
    # raising one arm of a tripod of radius r by d tilts the normal by 2 d / 3 r away from it
    expected_rad = -2.0 * twin.drives.travel_m(Leg(31, 0)) / (3.0 * 0.295)
    np.testing.assert_allclose(change_rad[row], [expected_rad, 0.0], atol=1e-3 * abs(expected_rad))
    # the dish sags a little in these 10 s
    np.testing.assert_allclose(np.delete(change_rad, row, axis=0), 0.0, atol=1e-4 * abs(expected_rad))


def test_drives_that_do_not_answer_are_told_together_and_the_others_work(tmp_path: Path) -> None:
    config = two_facets(tmp_path)
    clock = ManualClock()
    wiring = twin_wiring(config)
    silent = [Leg(13, 0), Leg(13, 2)]
    missing = tuple(wire for wire in wiring[1].wires if wire.leg not in silent)
    wiring = (wiring[0], type(wiring[1])(name="north", protocol="zaber", wires=missing))
    drives = TwinDrives(wiring, clock, FaultPlan(), seed=3)
    with build_twin_actuators(config, drives) as buses:
        south, north = buses
        assert south.unreachable == {}
        assert list(north.unreachable) == silent
        assert all("no usable answer in 2 attempts" in why for why in north.unreachable.values())
        assert list(north.drives) == [Leg(13, 0), Leg(13, 1), Leg(13, 2)]
        with pytest.raises(CommunicationError):
            north.drives[Leg(13, 0)].state()
        north.drives[Leg(13, 1)].start_move(0.0)
        scan = north.scan()
        assert "address 1 (facet 13 leg 1): does not answer properly: Zaber device 1" in scan[0]
        assert "address 2 (facet 13 leg 2): Zaber device id" in scan[1]


def test_a_bus_that_comes_back_is_connected_again(tmp_path: Path) -> None:
    config = two_facets(tmp_path)
    clock = ManualClock()
    drives = twin_drives(config, clock)
    drives.inject(FaultSpec("lost_answers", 0.0, 100.0, {"bus": "south", "share": 1.0}))
    with build_twin_actuators(config, drives) as buses:
        assert len(buses[0].unreachable) == 3
        assert buses[1].unreachable == {}
        clock.advance_to_s(101.0)
        assert buses[0].connect() == {}
        assert buses[0].unreachable == {}


def test_ports_that_cannot_be_opened_are_told_together_and_none_is_left_open(tmp_path: Path) -> None:
    config = two_facets(tmp_path, "/dev/no_such_port", "loopback://nobody")
    with pytest.raises(ConfigError) as refused, open_actuators(config):
        pass
    first, second = str(refused.value).splitlines()
    assert first.startswith("bus 'south': /dev/no_such_port can not be opened: there is no such port")
    assert second.startswith("bus 'north': loopback://nobody: nothing in this program answers there")
    with PtyLine(DriveLine(twin_drives(config, ManualClock()), "south")) as line:
        port = str(Path(line.port).resolve())
        config = two_facets(tmp_path, port, "/dev/no_such_port")
        with pytest.raises(ConfigError) as refused, open_actuators(config):
            pass
        with serial.Serial(port, exclusive=True):
            assert "no_such_port" in str(refused.value)  # which keeps alive what was opened, were it not closed


def test_hardware_is_opened_at_its_own_urls_and_let_go_of(tmp_path: Path) -> None:
    wiring = two_facets(tmp_path)
    drives = twin_drives(wiring, ManualClock())
    with PtyLine(DriveLine(drives, "south")) as south, PtyLine(DriveLine(drives, "north")) as north:
        ports = [str(Path(line.port).resolve()) for line in (south, north)]
        config = two_facets(tmp_path, *ports)
        with open_actuators(config) as buses:
            assert [bus.name for bus in buses] == [f"south ({ports[0]})", f"north ({ports[1]})"]
            assert [bus.unreachable for bus in buses] == [{}, {}]
            positions = [drive.state().position_m for bus in buses for drive in bus.drives.values()]
            assert positions == pytest.approx([drives.motor(leg).count * 3e-6 for leg in drives.legs])
        for port in ports:
            with serial.Serial(port, exclusive=True):
                pass


def test_the_twins_legs_have_the_play_of_the_configs_mount(tmp_path: Path) -> None:
    text = TWO_FACETS.format(south="loopback://a", north="loopback://b") + "\n[mount]\nbacklash_um = 42.0\n"
    (tmp_path / "it.toml").write_text(text)
    config = load_config(tmp_path / "it.toml")
    clock = ManualClock()
    drives = twin_drives(config, clock)
    leg = Leg(0, 2)
    travels_m = []
    with build_twin_actuators(config, drives) as buses:
        drive = buses[0].drives[leg]
        for target_m in (1e-3, 2e-3, 1e-3):
            drive.start_move(target_m)
            clock.wait_s(LONG_S)
            drive.state()
            travels_m.append(drives.travel_m(leg))
    assert travels_m[1] - travels_m[0] == pytest.approx(1e-3, abs=6e-6)
    assert travels_m[2] - travels_m[1] == pytest.approx(-(1e-3 - 42e-6), abs=6e-6)


def test_config_check_opens_ports_when_asked_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = two_facets(tmp_path)
    drives = twin_drives(config, ManualClock())

    def check(*options: str) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["namod-ctl", "config", "check", str(tmp_path / "two.toml"), *options])
        with pytest.raises(SystemExit) as done:
            cli.main()
        return int(done.value.code or 0), capsys.readouterr().err

    two_facets(tmp_path, "/dev/no_such_port", "socket://127.0.0.1:1")
    assert check()[0] == 0
    code, err = check("--ports")
    assert code == 2
    assert "bus 'south': /dev/no_such_port can not be opened: there is no such port" in err
    assert "bus 'north': socket://127.0.0.1:1 can not be opened" in err
    assert "Traceback" not in err
    with PtyLine(DriveLine(drives, "south")) as south:
        link = Path(south.port).resolve()
        two_facets(tmp_path, str(link), "loopback://nobody")
        with serial.Serial(str(link), exclusive=True):
            code, err = check("--ports")
        assert code == 2
        assert "the port is in use" in err
        assert "nothing in this program answers there" in err
        two_facets(tmp_path, str(link), str(link) + "9")
        assert "bus 'south'" not in check("--ports")[1]
    assert drives.log == ()  # nothing was said to any drive


def test_the_twin_stands_and_stays_within_the_soft_limits() -> None:
    for name in ACTUATED:
        config = load_config(name)
        drives = twin_drives(config, ManualClock())
        settings = {drive.leg: (bus, drive) for bus in build_bus_settings(config) for drive in bus.drives}
        starts = []
        for leg in drives.legs:
            bus, drive = settings[leg]
            start_m = drives.motor(leg).count / drive.steps_per_m
            assert bus.range_m[0] < start_m < bus.range_m[1]
            starts.append(start_m)
        assert np.std(starts) > 0.0
