"""How much a drive's driver says on the bus: telegrams are what a correction of a thousand facets waits for."""

from __future__ import annotations

import pytest

from namod_ctl.core.drives import Leg
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.devices.buses import BusSettings, DriveBus, DriveSettings
from namod_ctl.devices.drive_maps import load_register_map
from namod_ctl.devices.links import LineSettings
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan

LEG = Leg(1, 0)
PER_M = 1.0 / um_to_m(3.0)


def rig(kind: str) -> tuple[DriveBus, ManualClock]:
    protocol = "tmcl" if kind == "tmcl" else "modbus_rtu"
    register_map = None if kind == "tmcl" else load_register_map(kind)
    clock = ManualClock()
    wiring = BusWiring("a", protocol, (DriveWire(LEG, 1, 0, PER_M),), register_map=register_map, start_spread_m=0.0)
    drives = TwinDrives([wiring], clock, FaultPlan(), 1)
    settings = BusSettings(
        "a", "loopback://a", protocol, 115200, LineSettings(), 1, (DriveSettings(LEG, 1, 0, PER_M),),
        (mm_to_m(-5.0), mm_to_m(5.0)), mm_to_m(1.0), mm_to_m(5.0), register_map,
    )  # fmt: skip
    bus = DriveBus(settings, LoopbackTransport("loopback://a", lambda data: drives.receive("a", data)))
    assert not bus.connect()
    return bus, clock


@pytest.mark.parametrize(
    ("kind", "n_order", "n_look"),
    [
        # looks: at the state, after the mode, at the new set-point; writes: 0x0F, mode, target, 0x3F, 0x0F; readback
        ("cia402", 9, 2),
        # look at the state; mode, target, readback, trigger, taken
        ("pulse_stepper", 6, 3),
        # target and readback
        ("tmcl", 2, 6),
    ],
)
def test_orders_and_looks_take_no_more_telegrams_than_they_need(kind: str, n_order: int, n_look: int) -> None:
    bus, clock = rig(kind)
    drive = bus.drives[LEG]
    for target_m in (0.001, 0.002):  # the first order switches the drive on
        before = bus.statistics.n_exchanges
        drive.start_move(target_m)
        n_last = bus.statistics.n_exchanges - before
        clock.wait_s(5.0)
        first_temperature_k = drive.state().temperature_k
    assert n_last <= n_order
    before = bus.statistics.n_exchanges
    state = drive.state()
    assert bus.statistics.n_exchanges - before <= n_look + (kind == "tmcl")  # its position is read twice
    assert not state.is_moving
    assert state.temperature_k == first_temperature_k


def test_the_temperature_is_that_of_the_last_rest() -> None:
    bus, clock = rig("cia402")
    drive = bus.drives[LEG]
    cold_k = drive.state().temperature_k
    assert cold_k is not None
    for number in range(40):
        drive.start_move(0.004 if number % 2 else -0.004)
        clock.wait_s(10.0)
    warm_k = drive.state().temperature_k
    assert warm_k is not None
    assert warm_k > cold_k + 1.0
