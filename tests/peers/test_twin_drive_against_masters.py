"""Foreign masters on the wire: pytrinamic, zaber-motion, minimalmodbus and mbpoll drive the twin's drives."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "twin"))

from drive_twins import BUS, TickingClock, some_drives

from namod_ctl.core.drives import Leg
from namod_ctl.twin.drive_lines import DriveLine, PtyLine, TcpLine
from namod_ctl.twin.settings import FaultSpec

TICK_S = 0.05
"""Of the twin's time per request: foreign programs wait in their own time, and briefly."""
LEG = Leg(7, 1)
ADDRESS = 2
LIMIT_S = 20.0


def wait_until(is_so: Callable[[], bool]) -> None:
    begun_s = time.monotonic()
    while not is_so():
        assert time.monotonic() < begun_s + LIMIT_S


# --- TMCL: pytrinamic


@pytest.fixture
def trinamic():
    pytest.importorskip("pytrinamic", reason="pytrinamic is not installed (extra 'peers')")
    from pytrinamic.connections import SerialTmclInterface

    drives = some_drives("tmcl", clock=TickingClock(TICK_S))
    with PtyLine(DriveLine(drives, BUS)) as line:
        interface = SerialTmclInterface(line.port, timeout_s=5)
        yield drives, interface
        interface.close()


def test_pytrinamic_moves_homes_and_stops(trinamic) -> None:
    drives, interface = trinamic
    interface.set_axis_parameter(4, 0, 200, ADDRESS)
    assert interface.get_axis_parameter(4, 0, ADDRESS) == 200
    interface.move_to(0, -250, ADDRESS)
    wait_until(lambda: interface.get_axis_parameter(8, 0, ADDRESS) == 1)
    assert interface.get_axis_parameter(1, 0, ADDRESS, signed=True) == -250
    assert drives.motor(LEG).true_spindle_steps == -250
    interface.move_by(0, 3000, ADDRESS)
    interface.stop(0, ADDRESS)
    wait_until(lambda: interface.get_axis_parameter(3, 0, ADDRESS) == 0)
    assert interface.get_axis_parameter(8, 0, ADDRESS) == 0
    assert -250 <= drives.motor(LEG).count < 200
    interface.reference_search(0, 0, ADDRESS)
    wait_until(lambda: interface.reference_search(2, 0, ADDRESS) == 0)
    assert drives.motor(LEG).true_spindle_steps == 0
    assert drives.motor(LEG).is_homed


def test_pytrinamic_turns_and_asks_the_version(trinamic) -> None:
    drives, interface = trinamic
    assert interface.get_version_string(ADDRESS).startswith("6110V")
    interface.rotate(0, 100, ADDRESS)
    wait_until(lambda: interface.get_axis_parameter(3, 0, ADDRESS) == 100)
    interface.rotate(0, -100, ADDRESS)
    wait_until(lambda: interface.get_axis_parameter(3, 0, ADDRESS, signed=True) == -100)
    interface.stop(0, ADDRESS)
    wait_until(lambda: not drives.motor(LEG).is_moving)


def test_pytrinamic_is_told_of_its_mistakes(trinamic) -> None:
    from pytrinamic.tmcl import TMCLReplyStatusError

    _, interface = trinamic
    with pytest.raises(TMCLReplyStatusError, match=r"(?i)type"):
        interface.get_axis_parameter(250, 0, ADDRESS)
    with pytest.raises(TMCLReplyStatusError, match=r"(?i)value"):
        interface.set_axis_parameter(4, 0, 1_000_000, ADDRESS)


# --- Zaber: zaber-motion


@pytest.fixture
def zaber():
    pytest.importorskip("zaber_motion", reason="zaber-motion is not installed (extra 'peers')")
    from zaber_motion.ascii import Connection

    drives = some_drives("zaber", clock=TickingClock(TICK_S))
    with TcpLine(DriveLine(drives, BUS)) as line, Connection.open_tcp(line.host, line.port) as connection:
        yield drives, connection


def test_zaber_motion_moves_homes_and_stops(zaber) -> None:
    drives, connection = zaber
    connection.enable_alerts = False
    axis = connection.get_device(ADDRESS).get_axis(1)
    axis.home()
    assert axis.is_homed()
    axis.move_absolute(-250)
    assert axis.get_position() == -250
    axis.move_relative(50)
    assert drives.motor(LEG).true_spindle_steps == -200
    axis.move_absolute(3000, wait_until_idle=False)
    assert axis.is_busy()
    axis.stop()
    assert not axis.is_busy()
    assert -200 < axis.get_position() < 3000
    axis.settings.set("maxspeed", 300)
    assert axis.settings.get("maxspeed") == 300
    assert connection.get_device(ADDRESS).settings.get("system.serial") == 52002


def test_zaber_motion_is_told_of_rejections_and_warnings(zaber) -> None:
    from zaber_motion.exceptions.command_failed_exception import CommandFailedException
    from zaber_motion.exceptions.movement_failed_exception import MovementFailedException

    drives, connection = zaber
    axis = connection.get_device(ADDRESS).get_axis(1)
    with pytest.raises(CommandFailedException, match="BADDATA"):
        axis.move_absolute(1_000_000)
    assert axis.warnings.get_flags() == set()
    drives.inject(FaultSpec("drive_reset", 0.0, None, {"facet": 7, "leg": 2, "is_in_move": 0.0}))
    assert axis.warnings.get_flags() == {"WR"}
    drives.inject(FaultSpec("limit_switch", 0.0, None, {"facet": 7, "leg": 2, "end": 1.0}))
    with pytest.raises(MovementFailedException, match="Limit"):
        axis.move_absolute(200)
    assert axis.get_position() == 0


# --- Modbus RTU: minimalmodbus on a pty


@pytest.fixture
def minimal():
    minimalmodbus = pytest.importorskip("minimalmodbus", reason="minimalmodbus is not installed (extra 'peers')")
    drives = some_drives("modbus_rtu", clock=TickingClock(TICK_S))
    with PtyLine(DriveLine(drives, BUS)) as line:
        master = minimalmodbus.Instrument(line.port, ADDRESS)
        master.serial.baudrate = 115200
        master.serial.timeout = 0.3  # it waits so long for the rest of every exception, which is short
        yield drives, master
        master.serial.close()


def test_minimalmodbus_moves_a_drive(minimal) -> None:
    drives, master = minimal
    assert master.read_register(0x1003) == 0x0042
    master.write_long(0x6201, -250, signed=True)
    master.write_register(0x6200, 1, functioncode=6)
    master.write_register(0x6002, 0x10, functioncode=6)
    assert master.read_register(0x1003) & 0x04
    wait_until(lambda: not master.read_register(0x1003) & 0x04)
    assert master.read_long(0x602C, signed=True) == -250
    assert drives.motor(LEG).true_spindle_steps == -250


def test_minimalmodbus_is_told_of_its_mistakes(minimal) -> None:
    import minimalmodbus

    _, master = minimal
    with pytest.raises(minimalmodbus.IllegalRequestError, match="address"):
        master.read_register(0x7777)
    with pytest.raises(minimalmodbus.IllegalRequestError, match="value"):
        master.write_register(0x6203, 60000, functioncode=6)
    with pytest.raises(minimalmodbus.IllegalRequestError, match="function"):
        master.read_bit(0, functioncode=1)


# --- Modbus RTU and TCP: mbpoll

MBPOLL = shutil.which("mbpoll")
needs_mbpoll = pytest.mark.skipif(MBPOLL is None, reason="mbpoll is not installed (apt install mbpoll)")


def mbpoll(mode: list[str], line: PtyLine | TcpLine, *arguments: str, values: tuple[int, ...] = ()) -> str:
    """What mbpoll prints; its references count from 1 unless told otherwise (-0)."""
    where = [line.port] if isinstance(line, PtyLine) else ["-p", str(line.port), line.host]
    command = [str(MBPOLL), *mode, "-a", str(ADDRESS), "-0", "-q", "-1", "-o", "5", *arguments, *where]
    done = subprocess.run([*command, *map(str, values)], capture_output=True, text=True, check=False, timeout=30)
    return done.stdout + done.stderr


@needs_mbpoll
@pytest.mark.parametrize("protocol", ["modbus_rtu", "modbus_tcp"])
def test_mbpoll_moves_an_actuator_of_two_registers(protocol: str) -> None:
    """To +0.9 mm, 20900 um of its stroke."""
    drives = some_drives(protocol, clock=TickingClock(0.5), map_name="two_register")
    serial_mode = ["-m", "rtu", "-b", "115200", "-P", "none"]
    is_serial = protocol == "modbus_rtu"
    with (PtyLine if is_serial else TcpLine)(DriveLine(drives, BUS)) as line:
        mode = serial_mode if is_serial else ["-m", "tcp"]
        assert "Written 1 references" in mbpoll(mode, line, "-t", "4", "-r", "0", values=(20900,))
        wait_until(lambda: "[0]: \t20900" in mbpoll(mode, line, "-t", "3", "-r", "0"))
        assert math.isclose(drives.motor(LEG).true_spindle_steps, 900.0, abs_tol=1e-6)
        assert "Illegal data address" in mbpoll(mode, line, "-t", "4", "-r", "99")
        assert "Illegal data value" in mbpoll(mode, line, "-t", "4", "-r", "0", values=(65000,))
