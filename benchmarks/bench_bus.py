"""A full correction of 1000 facets with two legs each on eight lines, against what the lines allow; and our own time.

Run: python benchmarks/bench_bus.py [n_facets]

The product's mover, drivers and links speak to the twin's drives over lines in memory that keep account of time:
every byte takes 11 bits at 115200 baud, a drive answers `TURNAROUND_S` after the question, and on Modbus RTU 1.75 ms of
silence follow every telegram (MODBUS over Serial Line V1.02, 2.5.1.1: the fixed value above 19200 baud). All of it
takes the computer's own time: about four minutes.

The minimum is what no controller could undercut that keeps the same rules. For the slowest line the larger of
- wire: the exchanges that every leg needs. Two looks at its state before it moves, rules of safety both: one at all
  drives before any of them moves, for a facet moves whole or not at all; and one right before its start, for an order
  is refused when the readback has changed since. The telegrams by which the drive takes a target, once per way, two
  ways where the target lies below: the writes of its map's "move" sequence, and one look for all that is waited for
  between two of them; before the first also those that switch the drive on. A look every `LOOK_S` while it moves, so
  that a fault is seen in time, and one that sees the end of each way; and one, the readback, when it has settled. A
  look are the fewest requests that read position, moving, homed and faults.
  The bare minimum leaves out the two looks before the start; "bare" is the ratio against that one.
- motion: the ways of all legs with their ramps, and the settling of each, shared by the drives that may move at once,
  and not below the longest of one leg.

"own ms" is the processor's time per exchange outside of the twin's drives, of the whole correction: mover, drive, link.
Below the table: one exchange of the link alone, beside minimalmodbus, which reads the same registers on the same line.

Modbus addresses end at 247; the last three legs of a line of 250 have the reserved ones up to 250.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from dataclasses import dataclass, field

import minimalmodbus  # type: ignore[import-untyped]
import numpy as np
import serial  # type: ignore[import-untyped]
from pymodbus.framer.rtu import FramerRTU

from firmware_protocols import tmcl
from firmware_protocols.modbus_drive import RegisterMap, RunUnless, WaitFor, WriteConstant, WriteTarget
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.cycle.leg_course import approach_of
from namod_ctl.cycle.mover import Mover
from namod_ctl.devices.buses import BusSettings, DriveBus, DriveSettings, ProtocolName
from namod_ctl.devices.drive_maps import load_register_map
from namod_ctl.devices.links import LineSettings, TmclLink
from namod_ctl.devices.modbus_link import Framing, ModbusLink
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.twin.drive_settings import MotorSettings
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan

N_BUSES, N_LEGS, MAX_MOVING = 8, 2, 15
BAUD, BITS_PER_BYTE = 115_200, 11
RTU_SILENCE_S, TURNAROUND_S = 0.00175, 0.001
LOOK_S = 0.25
N_LOOKS_BEFORE = 2
TRAVEL_M = mm_to_m(0.3)
SPEED_M_PER_S, ACCELERATION_M_PER_S2 = mm_to_m(1.0), mm_to_m(5.0)
MOTION = MotionSettings(mm_to_m(5.0), mm_to_m(0.05), um_to_m(6.0), 0.1, 0.05, SPEED_M_PER_S)
"""What a config has that says nothing else."""
RANGE_M = (mm_to_m(-5.0), mm_to_m(5.0))
LIMIT_RATIO, LIMIT_OWN_S = 1.2, 0.001
N_REPEATS = 5000


@dataclass
class TimedLine:
    """A line in memory on which everything takes the time that it takes on a wire."""

    name: str
    silence_s: float
    n_exchanges: int = 0
    busy_s: float = 0.0
    drives_s: float = 0.0
    drives: TwinDrives = field(init=False)
    _overslept_s: float = 0.0

    def __call__(self, question: bytes) -> bytes:
        """The drives' answer when it is through. What the computer oversleeps is given back: a wire does not."""
        end_s = time.monotonic() - self._overslept_s
        begun = time.thread_time()
        answer = self.drives.receive(self.name, question)
        self.drives_s += time.thread_time() - begun
        duration_s = wire_s(len(question) + len(answer)) + TURNAROUND_S + 2.0 * self.silence_s
        end_s += duration_s
        time.sleep(max(end_s - time.monotonic(), 0.0))
        self._overslept_s = time.monotonic() - end_s
        self.n_exchanges += 1
        self.busy_s += duration_s
        return answer


def wire_s(n_bytes: int) -> float:
    return n_bytes * BITS_PER_BYTE / BAUD


def way_s(way_m: float) -> float:
    """Duration of a trapezoidal motion."""
    ramp_m = SPEED_M_PER_S**2 / ACCELERATION_M_PER_S2
    if way_m < ramp_m:
        return 2.0 * math.sqrt(way_m / ACCELERATION_M_PER_S2)
    return way_m / SPEED_M_PER_S + SPEED_M_PER_S / ACCELERATION_M_PER_S2


# --- what a controller must at least exchange


class ModbusCosts:
    """Durations of the exchanges that a register map makes necessary."""

    def __init__(self, register_map: RegisterMap) -> None:
        self._map = register_map
        known = register_map.conditions.values()
        names = {t.register for c in known if c.fault is not None or c.name in ("moving", "homed") for t in c.terms}
        names |= {register_map.position}
        self.look = self._reads(names if "moving" in register_map.conditions else {*names, register_map.target})
        self.order = self._sequence("move")
        self.begin = self._sequence("enable") if "enable" in register_map.sequences else (0, 0.0)

    def _reads(self, names: set[str]) -> tuple[int, float]:
        blocks = self._map.reads(names)
        return len(blocks), sum(exchange_s(8, 5 + 2 * block.count) for block in blocks)

    def _sequence(self, name: str) -> tuple[int, float]:
        """Its writes, and one look for all that is waited for between two of them; branches are known by the look."""
        n, duration_s, wanted = 0, 0.0, set[str]()
        for step in [*self._map.sequences[name], None]:
            if isinstance(step, WaitFor):
                wanted |= {term.register for term in self._map.conditions[step.condition].terms}
            elif not isinstance(step, RunUnless):
                costs = [self._reads(wanted)] if wanted else []
                wanted = set()
                if isinstance(step, WriteConstant | WriteTarget):
                    written = step.register if isinstance(step, WriteConstant) else self._map.target
                    register = self._map.registers[written]
                    n_question = 8 if register.write == 6 else 9 + 2 * register.count
                    costs.append((1, exchange_s(n_question, 8)))
                n, duration_s = n + sum(cost[0] for cost in costs), duration_s + sum(cost[1] for cost in costs)
        return n, duration_s


class TmclCosts:
    """TMCL has no read of several parameters: position, reached, homed, two words of faults; MVP."""

    look = (5, 5 * (2 * wire_s(tmcl.FRAME_LENGTH) + TURNAROUND_S))
    order = (1, 2 * wire_s(tmcl.FRAME_LENGTH) + TURNAROUND_S)
    begin = (0, 0.0)


def exchange_s(n_question: int, n_answer: int) -> float:
    return wire_s(n_question + n_answer) + 2.0 * RTU_SILENCE_S + TURNAROUND_S


def minimum(travels_m: list[float], costs: ModbusCosts | TmclCosts, n_looks_before: int) -> tuple[float, float, float]:
    """Wire and motion in s, and exchanges per leg, of one line."""
    n_total, line_s, ways = 0.0, 0.0, []
    for travel_m in travels_m:
        stops = (0.0, *approach_of(0.0, travel_m, MOTION.approach_m))
        moving_s = [way_s(abs(end - start)) for start, end in itertools.pairwise(stops)]
        n_looks = n_looks_before + 1 + sum(1 + math.floor(each / LOOK_S) for each in moving_s)
        ways.append(sum(moving_s) + MOTION.settle_s)
        n_total += costs.begin[0] + n_looks * costs.look[0] + len(moving_s) * costs.order[0]
        line_s += costs.begin[1] + n_looks * costs.look[1] + len(moving_s) * costs.order[1]
    return line_s, max(sum(ways) / MAX_MOVING, max(ways)), n_total / len(travels_m)


# --- what ours does


def correct(kind: str, n_facets: int) -> tuple[str, float, float]:
    """A row of the table, the ratio, and our own seconds per exchange."""
    protocol: ProtocolName = "tmcl" if kind == "tmcl" else "modbus_rtu"
    register_map = None if kind == "tmcl" else load_register_map(kind)
    per_m = 1e6 if kind == "two_register" else 1.0 / um_to_m(3.0)
    legs = [Leg(facet, leg) for facet in range(n_facets) for leg in range(N_LEGS)]
    size = math.ceil(len(legs) / N_BUSES)
    clock = SystemMonotonicClock()
    lines: list[TimedLine] = []
    buses: list[DriveBus] = []
    for number in range(N_BUSES):
        own = legs[number * size : (number + 1) * size]
        line = TimedLine(f"line{number}", 0.0 if kind == "tmcl" else RTU_SILENCE_S)
        wires = tuple(DriveWire(leg, address, 0, per_m) for address, leg in enumerate(own, start=1))
        motor = MotorSettings(max_speed_m_per_s=SPEED_M_PER_S, max_acceleration_m_per_s2=ACCELERATION_M_PER_S2)
        wiring = BusWiring(line.name, protocol, wires, motor, register_map, start_spread_m=0.0)
        line.drives = TwinDrives([wiring], clock, FaultPlan(), seed=1)
        settings = BusSettings(
            line.name, f"loopback://{line.name}", protocol, BAUD, LineSettings(), MAX_MOVING,
            tuple(DriveSettings(wire.leg, wire.address, 0, per_m) for wire in wires),
            RANGE_M, SPEED_M_PER_S, ACCELERATION_M_PER_S2, register_map,
        )  # fmt: skip
        buses.append(DriveBus(settings, LoopbackTransport(settings.url, line)))
        lines.append(line)
        if buses[-1].connect():
            raise RuntimeError(f"not all drives answer: {buses[-1].unreachable}")
    mover = Mover(buses, clock, MOTION, StopSwitch())
    starts = {leg: state.position_m for leg, state in mover.read_states().items() if not isinstance(state, str)}
    travels = dict(zip(legs, np.random.default_rng(7).normal(0.0, TRAVEL_M, len(legs)).tolist(), strict=True))
    for line in lines:
        line.n_exchanges, line.busy_s, line.drives_s = 0, 0.0, 0.0
    begun_s, begun_cpu = clock.monotonic_s(), time.process_time()
    orders = [MoveOrder(leg, starts[leg], starts[leg] + travels[leg]) for leg in legs]
    results = mover.execute(orders, lambda result: None, lambda: None)
    ours_s, cpu_s = clock.monotonic_s() - begun_s, time.process_time() - begun_cpu
    if any(result.outcome is not MoveOutcome.ARRIVED for result in results):
        raise RuntimeError("not all legs have arrived")
    costs = TmclCosts() if register_map is None else ModbusCosts(register_map)
    shares = [[travels[leg] for leg in legs[i * size : (i + 1) * size]] for i in range(N_BUSES)]
    bounds = [minimum(share, costs, N_LOOKS_BEFORE) for share in shares]
    wire_min_s, motion_s, n_min = max(bounds, key=lambda bound: max(bound[:2]))
    minimum_s = max(wire_min_s, motion_s)
    bare_s = max(max(minimum(share, costs, 0)[:2]) for share in shares)
    n_exchanges = sum(line.n_exchanges for line in lines)
    own_s = (cpu_s - sum(line.drives_s for line in lines)) / n_exchanges
    busy_s = max(line.busy_s for line in lines)
    row = (
        f"{kind:14} {ours_s:8.2f} {minimum_s:8.2f} {wire_min_s:7.2f} {motion_s:7.2f} {ours_s / minimum_s:6.2f} "
        f"{bare_s:8.2f} {ours_s / bare_s:6.2f} "
        f"{busy_s:8.2f} {n_exchanges / len(legs):7.1f} {n_min:7.1f} {own_s * 1e3:8.3f}"
    )
    return row, ours_s / minimum_s, own_s


# --- one exchange


class CannedSerial(serial.Serial):  # type: ignore[misc]
    """What minimalmodbus takes for an open port; always the same answer."""

    def __init__(self, answer: bytes) -> None:
        super().__init__()
        self.is_open, self._answer = True, answer

    def write(self, data: bytes) -> int:
        return len(data)

    def read(self, size: int = 1) -> bytes:
        return self._answer[:size]

    def reset_input_buffer(self) -> None:
        """Nothing is left."""

    reset_output_buffer = reset_input_buffer


def one_exchange() -> None:
    frame = bytes([7, 3, 4, 0, 1, 0, 2])
    answer = frame + FramerRTU.compute_CRC(frame).to_bytes(2, "big")
    link = ModbusLink(LoopbackTransport("loopback://one", lambda data: answer), LineSettings(), Framing.RTU)
    instrument = minimalmodbus.Instrument(CannedSerial(answer), 7)
    reply = tmcl.Reply(2, 5, tmcl.Status.OK, tmcl.Command.GAP, 99).encode()
    token = b""

    def module(data: bytes) -> bytes:
        nonlocal token
        if data[1] == tmcl.Command.SGP:
            token = data[4:8]
        if data[1] in (tmcl.Command.SGP, tmcl.Command.GGP):
            return tmcl.Reply(2, 5, tmcl.Status.OK, data[1], int.from_bytes(token, "big")).encode()
        return reply

    tmcl_link = TmclLink(LoopbackTransport("loopback://one", module), LineSettings())
    request = tmcl.Request(5, tmcl.Command.GAP, 1)
    for name, exchange in (
        ("ours, Modbus RTU", lambda: link.read(7, 3, 100, 2)),
        ("minimalmodbus", lambda: instrument.read_registers(100, 2)),
        ("ours, TMCL", lambda: tmcl_link.exchange(request)),
    ):
        exchange()
        begun = time.process_time()
        for _ in range(N_REPEATS):
            exchange()
        print(f"{name:18} {(time.process_time() - begun) / N_REPEATS * 1e3:.3f} ms")


def main() -> None:
    n_facets = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print(__doc__.splitlines()[0])
    print(
        f"{n_facets} facets, {N_BUSES} lines, {MAX_MOVING} drives at once on each, travels of {TRAVEL_M * 1e3:g} mm rms"
    )
    print(
        f"{'drives':14} {'ours s':>8} {'min s':>8} {'wire s':>7} {'motion':>7} {'ratio':>6} "
        f"{'bare s':>8} {'bare':>6} {'busy s':>8} {'exch.':>7} {'min':>7} {'own ms':>8}"
    )
    for kind in ("cia402", "pulse_stepper", "two_register", "tmcl"):
        row, ratio, own_s = correct(kind, n_facets)
        is_kept = own_s <= LIMIT_OWN_S and (kind == "tmcl" or ratio <= LIMIT_RATIO)
        print(row, "" if is_kept else "  over the limit", flush=True)
    print(f"limits: ratio {LIMIT_RATIO:g} on Modbus RTU, own {LIMIT_OWN_S * 1e3:g} ms")
    one_exchange()


if __name__ == "__main__":
    main()
