"""Our Modbus client against slaves of libmodbus and modbus-tk, on TCP and on RTU over a pseudo terminal."""

from __future__ import annotations

import importlib.util
import os
import select
import shutil
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.units import mm_to_m
from namod_ctl.devices.drive_maps import load_register_map
from namod_ctl.devices.links import LineSettings
from namod_ctl.devices.modbus_drive import ModbusDrive
from namod_ctl.devices.modbus_link import Framing, ModbusLink
from namod_ctl.devices.transports import open_transport

HERE = Path(__file__).parent
UNIT = 17
SETTINGS = LineSettings(timeout_s=0.5, n_retries=1)
pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pseudo terminals")


@contextmanager
def cable() -> Iterator[tuple[str, str]]:
    """Names of two serial ports that are joined by a cable."""
    masters_and_slaves = [os.openpty(), os.openpty()]
    masters = [master for master, _ in masters_and_slaves]
    for _, slave in masters_and_slaves:
        tty.setraw(slave)
    wake_read, wake_write = os.pipe()

    def carry() -> None:
        while wake_read not in (ready := select.select([*masters, wake_read], [], [])[0]):
            for master in ready:
                os.write(masters[1 - masters.index(master)], os.read(master, 4096))

    carrier = threading.Thread(target=carry)
    carrier.start()
    try:
        yield os.ttyname(masters_and_slaves[0][1]), os.ttyname(masters_and_slaves[1][1])
    finally:
        os.write(wake_write, b"x")
        carrier.join()
        for handle in (*(handle for pair in masters_and_slaves for handle in pair), wake_read, wake_write):
            os.close(handle)


@pytest.fixture(scope="module")
def libmodbus_program(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc to compile the libmodbus slave with")
    program = tmp_path_factory.mktemp("libmodbus") / "slave"
    source = HERE / "libmodbus_slave.c"
    has_header = subprocess.run(
        [compiler, "-E", "-xc", "-"], input=b"#include <modbus/modbus.h>", capture_output=True, check=False
    )
    if has_header.returncode != 0:
        pytest.skip("no libmodbus headers (Debian: libmodbus-dev)")
    subprocess.run([compiler, "-o", program, source, "-lmodbus"], check=True)
    return [str(program)]


@pytest.fixture(scope="module")
def modbus_tk_program() -> list[str]:
    if importlib.util.find_spec("modbus_tk") is None:
        pytest.skip("modbus-tk is not installed (extra: peers)")
    return [sys.executable, str(HERE / "modbus_tk_slave.py")]


@pytest.fixture(params=["libmodbus", "modbus_tk"])
def program(request: pytest.FixtureRequest) -> list[str]:
    return list(request.getfixturevalue(f"{request.param}_program"))


@pytest.fixture(params=Framing, ids=lambda framing: framing.value)
def link(request: pytest.FixtureRequest, program: list[str]) -> Iterator[ModbusLink]:
    with ExitStack() as stack:
        ours, theirs = ("", "tcp") if request.param is Framing.TCP else stack.enter_context(cable())
        slave = subprocess.Popen([*program, theirs], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        stack.callback(slave.communicate)
        stack.callback(slave.kill)
        assert slave.stdout is not None
        port = int(slave.stdout.readline())
        url = ours or f"socket://127.0.0.1:{port}"
        link = ModbusLink(open_transport(url, 115200), SETTINGS, request.param)
        stack.callback(link.close)
        yield link


def test_registers_of_a_foreign_slave(link: ModbusLink) -> None:
    assert link.read(UNIT, 4, 9, 3) == (81, 100, 121)  # the slaves hold squares
    link.write(UNIT, 16, 20, [0xFFFE, 0x1DC0, 7])
    link.write(UNIT, 6, 22, [0xBEEF])
    assert link.read(UNIT, 3, 20, 3) == (0xFFFE, 0x1DC0, 0xBEEF)
    assert link.read(UNIT, 3, 0, 100) == (*(0,) * 20, 0xFFFE, 0x1DC0, 0xBEEF, *(0,) * 77)
    assert link.statistics.n_retries == 0


def test_its_refusals_come_in_words(link: ModbusLink) -> None:
    for refused in (lambda: link.read(UNIT, 3, 99, 2), lambda: link.write(UNIT, 6, 100, [1])):
        with pytest.raises(DeviceFaultError, match="it has no such register"):
            refused()
    assert link.read(UNIT, 4, 3, 1) == (9,)


def test_an_actuator_of_two_registers(link: ModbusLink) -> None:
    register_map = load_register_map("two_register")
    drive = ModbusDrive(
        link,
        UNIT,
        register_map,
        steps_per_m=-1e6,
        range_m=(-0.01, 0.01),
        speed_m_per_s=1e-3,
        acceleration_m_per_s2=1e-2,
    )
    for target_m in (mm_to_m(1.234), mm_to_m(-9.999), 0.0):
        drive.start_move(target_m)
        state = drive.state()
        assert state.position_m == pytest.approx(target_m, abs=drive.resolution_m / 2)
        assert (state.is_moving, state.is_homed, state.faults) == (False, True, ())
    # 0 mm is the middle of 40 mm, at 1 um per count
    assert link.read(UNIT, 3, 0, 1) == (20000,)


def test_another_unit_is_not_there(link: ModbusLink, request: pytest.FixtureRequest) -> None:
    if "libmodbus" in request.node.name and "tcp" in request.node.name:
        pytest.skip("libmodbus answers every unit on TCP")
    with pytest.raises((CommunicationError, DeviceFaultError)):
        link.read(UNIT + 1, 4, 1, 1)
    assert link.read(UNIT, 4, 5, 1) == (25,)
