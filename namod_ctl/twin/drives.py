"""All drives of a twin: motors, their electronics on their buses, what they did, and the travel of the legs."""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.twin.drive_modbus import ModbusRtuLine, ModbusTcpLine
from namod_ctl.twin.drive_modbus_units import FollowingUnit, ModbusUnit, unit_kind
from namod_ctl.twin.drive_motor import Conditions, DriveMotor
from namod_ctl.twin.drive_tmcl import TmclLine, TmclModule
from namod_ctl.twin.drive_wiring import WIRING_FAULTS, BusWiring, Gearing, true_addresses, true_gearing
from namod_ctl.twin.drive_zaber import ZaberDevice, ZaberLine
from namod_ctl.twin.faults import DRIVE_CATALOGUE, EVERY_BUS, EVERY_FACET, EVERY_LEG, NO_FACET, Fault, FaultPlan
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import FaultSpec

MOTION_FAULTS = frozenset({"stuck_leg", "lost_steps", "backlash_grown", "limit_switch", "supply_sag", "drive_reset"})
FAULTS_IN_TIME = MOTION_FAULTS | WIRING_FAULTS
ENDLESS_MOVE_S = 1.0
"""What counts as the length of a motion whose end is not known, a search for the reference, for a reset in it."""
NOTE_S = 1.0

Journal = Callable[[float, Mapping[str, Any]], None]
"""Told the moment (s) and what came in from outside then, in JSON's types; see `world`."""


def keep_no_journal(time_s: float, what: Mapping[str, Any]) -> None:
    """What comes in is forgotten with the twin."""


@dataclass(frozen=True, slots=True)
class LogEntry:
    """What a motor was ordered or did.

    Attributes
    ----------
    leg
        Whose drive it is by the config.
    order
        "move", "home", "rotate", "stop": orders; "reset", "arrived" and the names of what stopped it: events.
    start_m, end_m
        By the drive's count, along the leg as the config has it; of "arrived": how the spindle really moved.
    """

    time_s: float
    leg: Leg
    order: str
    start_m: float
    end_m: float


_Unit = TypeVar("_Unit")


class _Line(Protocol):
    def receive(self, data: bytes) -> bytes: ...


class TwinDrives:
    """The drives of all buses; safe to use from the threads of all lines and from the twin's.

    Attributes
    ----------
    wiring
        As the config has it; what is wrong with it are faults.
    faults, clock, seed
        The twin's.
    journal
        Told what comes in from outside, and the time at least every `NOTE_S` while somebody speaks.
    """

    def __init__(self, wiring: Sequence[BusWiring], clock: MonotonicClock, faults: FaultPlan, seed: int) -> None:
        self.wiring = {bus.name: bus for bus in wiring}
        self.faults, self.clock, self.seed = faults, clock, seed
        self.journal: Journal = keep_no_journal
        self._lock = threading.RLock()
        self._now_s = self._noted_s = clock.monotonic_s()
        self._log: list[LogEntry] = []
        self._motors: dict[Leg, DriveMotor] = {}
        self._per_m: dict[Leg, float] = {}
        self._bus_of: dict[Leg, str] = {}
        self._legs_at: dict[tuple[str, int], list[Leg]] = defaultdict(list)
        self._legs_of: dict[int, list[Leg]] = defaultdict(list)
        self._started_s: dict[Leg, float] = {}
        self._moving: dict[Leg, None] = {}  # in the order of their orders: the same in every run; all others rest
        self._resets_done: set[tuple[int, Leg]] = set()
        for bus in wiring:
            for wire in bus.wires:
                self._add(bus, wire.leg, wire.steps_per_m)
        self._lines = {bus.name: self._line(bus) for bus in wiring}
        self._gearing = {leg: Gearing(leg) for leg in self._motors}
        self._driven_by = {leg: leg for leg in self._motors}  # by leg: whose motor moves it
        self._base_leg_steps = {leg: motor.true_leg_steps for leg, motor in self._motors.items()}
        self._base_travel_m = dict.fromkeys(self._motors, 0.0)
        self._moved: set[int] = set()
        for fault in [fault for name in DRIVE_CATALOGUE for fault in faults.of(name)]:
            self.refuse_unknown(FaultSpec(fault.name, fault.start_s, None, fault.params))
        self._regear()

    # --- for the wire

    def receive(self, bus: str, data: bytes) -> bytes:
        """What the drives of a bus answer, now, to bytes that reach them all."""
        with self._lock:
            self.update(self.clock.monotonic_s())
            if self._now_s >= self._noted_s + NOTE_S:
                self._note({})
            return self._lines[bus].receive(data)

    # --- for the twin

    def update(self, time_s: float) -> None:
        """Let all motors go on until `time_s`; nothing if that is over."""
        with self._lock:
            if not self._moving and not self.faults.has_any(FAULTS_IN_TIME):
                self._now_s = max(self._now_s, time_s)
                return
            while True:
                self._obey_faults()
                if self._now_s >= time_s:
                    return
                end_s = self.faults.next_change_s(FAULTS_IN_TIME, self._now_s, time_s)
                end_s = min([end_s, *self._reset_moments_s(end_s)])
                if self.faults.active("supply_sag", self._now_s):  # then it matters when one of them gets there
                    end_s = min([end_s, *(self._motors[leg].end_s for leg in self._moving)])
                for leg in tuple(self._moving):
                    self._moved.add(self._gearing[leg].leg.facet_id)
                    self._motors[leg].update(end_s)
                self._now_s = end_s

    def take_moved(self) -> set[int]:
        """The facets whose legs may have moved since the last call."""
        with self._lock:
            moved, self._moved = self._moved, set()
            return moved

    def travel_m(self, leg: Leg) -> float:
        """How far a leg has truly travelled along +z since the twin began, at the last update.

        Raises KeyError for a leg without a drive.
        """
        with self._lock:
            driven = self._driven_by[leg]
            return self._base_travel_m[leg] + self._motor_travel_m(driven)

    def facet_travel_m(self, facet_id: int) -> dict[int, float]:
        """True travels of a facet's legs by their index; legs without a drive are not in it."""
        with self._lock:
            return {leg.index: self.travel_m(leg) for leg in self._legs_of.get(facet_id, ())}

    def motor(self, leg: Leg) -> DriveMotor:
        """The motor that the config has for a leg, now; tests look at the truth in it. Raises KeyError."""
        with self._lock:
            self.update(self.clock.monotonic_s())
            self._call(leg)
            return self._motors[leg]

    @property
    def legs(self) -> tuple[Leg, ...]:
        """All legs that have a drive."""
        return tuple(self._motors)

    @property
    def log(self) -> tuple[LogEntry, ...]:
        """Everything the motors were ordered and did, in the order of time."""
        with self._lock:
            return tuple(self._log)

    def inject(self, spec: FaultSpec) -> Fault:
        """Inject a fault of `faults.CATALOGUE`, also one that is none of drives.

        Raises
        ------
        ConfigError
            No such fault, parameter or value, or a facet, leg or bus without a drive.
        """
        with self._lock:
            self.refuse_unknown(spec)
            self.update(self.clock.monotonic_s())  # what went before goes on as it began
            fault = self.faults.inject(spec)
            self._note(
                {"fault": spec.name, "from_s": spec.start_s, "for_s": spec.duration_s, "params": {**spec.params}}
            )
            return fault

    def refuse_unknown(self, spec: FaultSpec) -> None:
        """Refuse a fault of a facet, leg or bus that has no drive.

        Raises
        ------
        ConfigError
            It names what there is.
        """
        if spec.name not in DRIVE_CATALOGUE:
            return
        given = {**DRIVE_CATALOGUE[spec.name].defaults, **spec.params}
        facets = sorted(self._legs_of)
        where = f"fault {spec.name!r}"
        if not self._motors:
            raise ConfigError(f"{where}: this twin has no drives")
        if given.get("bus", EVERY_BUS) not in (EVERY_BUS, *self.wiring):
            raise ConfigError(
                f"{where}: there is no bus {given['bus']!r}; there are: {', '.join(self.wiring) or 'none'}"
            )
        for prefix in ("", "other_"):
            facet, number = given.get(f"{prefix}facet"), given.get(f"{prefix}leg", EVERY_LEG)
            may_be_all = DRIVE_CATALOGUE[spec.name].defaults.get("leg") == EVERY_LEG
            if facet is None or (facet == EVERY_FACET and may_be_all):
                continue
            if facet == NO_FACET or facet not in facets:
                raise ConfigError(f"{where}: {prefix}facet = {facet!r} has no drive; facets with drives: {facets}")
            legs = [leg.index + 1 for leg in self._legs_of[int(facet)]]
            if number not in (EVERY_LEG, *legs) or (number == EVERY_LEG and f"{prefix}leg" in given and not may_be_all):
                raise ConfigError(f"{where}: {prefix}leg = {number!r}; facet {facet:g} has the legs {legs}")

    # --- inside

    def _add(self, bus: BusWiring, leg: Leg, steps_per_m: float) -> None:
        if leg in self._motors:
            raise ConfigError(f"bus {bus.name!r}: {leg} has a drive already, on bus {self._bus_of[leg]!r}")
        settings = replace(bus.motor, steps_per_m=abs(steps_per_m))
        if bus.register_map is not None and unit_kind(bus.register_map) is FollowingUnit:
            settings = replace(settings, has_encoder=True, is_absolute=True)
        spread = bus.start_spread_m * abs(steps_per_m)
        start = generator(self.seed, f"start of {leg}").uniform(-spread, spread)

        def note(time_s: float, what: str, start: float, end: float) -> None:
            self._log.append(LogEntry(time_s, leg, what, start / steps_per_m, end / steps_per_m))
            if what in ("move", "home", "rotate"):
                self._started_s[leg] = time_s
                self._moving[leg] = None
            elif what in ("arrived", "reset"):
                self._moving.pop(leg, None)

        self._legs_of[leg.facet_id].append(leg)
        is_homed = bus.is_homed or settings.is_absolute
        self._motors[leg] = DriveMotor(settings, round(start), is_homed, note)
        self._motors[leg].update(self._now_s)
        self._per_m[leg], self._bus_of[leg] = steps_per_m, bus.name

    def _line(self, bus: BusWiring) -> _Line:
        grouped: dict[int, dict[int, DriveMotor]] = defaultdict(dict)
        for wire in bus.wires:
            if wire.axis in grouped[wire.address]:
                raise ConfigError(f"bus {bus.name!r}: two drives with address {wire.address}, axis {wire.axis}")
            grouped[wire.address][wire.axis] = self._motors[wire.leg]
        for wire in bus.wires:
            self._legs_at[bus.name, wire.address].append(wire.leg)
        addresses = tuple(grouped)

        def heard(telegram: bytes) -> None:
            self._note({"bus": bus.name, "telegram": telegram.hex()})

        if bus.protocol == "tmcl":
            modules = {address: TmclModule(address, motors) for address, motors in grouped.items()}
            return TmclLine(lambda address: self._listeners(bus, modules, address), frozenset(addresses), heard)
        if bus.protocol == "zaber":
            devices = {address: ZaberDevice(address, motors) for address, motors in grouped.items()}
            return ZaberLine(lambda address: self._listeners(bus, devices, address), addresses, heard)
        if bus.register_map is None:
            raise ConfigError(f"bus {bus.name!r}: drives on Modbus need a register map")
        kind = unit_kind(bus.register_map)
        units: dict[int, ModbusUnit] = {}
        for address, motors in grouped.items():
            if len(motors) > 1:
                raise ConfigError(
                    f"bus {bus.name!r}: unit {address} has several drives; on Modbus each has its own address"
                )
            units[address] = kind(address, bus.register_map, next(iter(motors.values())))
        if bus.protocol == "modbus_rtu":
            return ModbusRtuLine(lambda address: self._listeners(bus, units, address), addresses, heard)
        return ModbusTcpLine(lambda address: self._listeners(bus, units, address), heard)

    def _note(self, what: Mapping[str, Any]) -> None:
        self._noted_s = self._now_s
        self.journal(self._now_s, what)

    def _listeners(self, bus: BusWiring, units: Mapping[int, _Unit], address: int) -> list[_Unit]:
        own_addresses = [address] if address in units else []
        if self.faults.of("same_address"):
            listening_to = true_addresses(bus.wires, self.faults, self._now_s)
            own_addresses = [own for own in units if listening_to[own] == address]
        for own in own_addresses:
            for leg in self._legs_at[bus.name, own]:
                self._call(leg)
        return [units[own] for own in own_addresses]

    def _call(self, leg: Leg) -> None:
        """Bring a motor, which may have rested for long, to the present moment and its conditions."""
        self._motors[leg].update(self._now_s)
        if self.faults.has_any(MOTION_FAULTS):
            self._motors[leg].conditions = self._conditions(leg)

    def _obey_faults(self) -> None:
        """Put moving motors under the conditions of the present moment, and reset what is to be reset now."""
        if self.faults.has_any(WIRING_FAULTS):
            self._regear()
        if self.faults.of("drive_reset"):
            for leg, motor in self._motors.items():
                for fault, moment_s in self._pending_resets(leg):
                    if moment_s <= self._now_s:
                        self._resets_done.add((fault, leg))
                        motor.update(self._now_s)
                        motor.reset()
        for leg in tuple(self._moving):
            self._call(leg)

    def _conditions(self, leg: Leg) -> Conditions:
        n_moving = sum(self._bus_of[moving] == self._bus_of[leg] for moving in self._moving)

        def values(name: str, parameter: str) -> list[float]:
            active = self.faults.active(name, self._now_s)
            return [fault.value(parameter) for fault in active if fault.concerns_leg(self._gearing[leg].leg)]

        sags = [
            fault.value("share")
            for fault in self.faults.active("supply_sag", self._now_s)
            if fault.concerns_bus(self._bus_of[leg]) and n_moving > fault.value("count")
        ]
        kept = math.prod(1.0 - min(max(share, 0.0), 1.0) for share in (*values("lost_steps", "share"), *sags))
        ends = values("limit_switch", "end")
        return Conditions(
            lost_share=1.0 if values("stuck_leg", "leg") else 1.0 - kept,
            backlash_factor=math.prod(values("backlash_grown", "factor")),
            is_low_limit_stuck=any(end < 0.0 for end in ends),
            is_high_limit_stuck=any(end > 0.0 for end in ends),
        )

    def _pending_resets(self, leg: Leg) -> list[tuple[int, float]]:
        """Numbers of faults that will reset this drive, and the moments: infinite for not before a move."""
        found = []
        motor = self._motors[leg]
        for fault in self.faults.of("drive_reset"):
            if not fault.concerns_leg(leg) or (fault.number, leg) in self._resets_done or self._now_s >= fault.end_s:
                continue
            moment_s = fault.start_s
            if fault.value("is_in_move"):
                begun_s = self._started_s.get(leg, 0.0)
                end_s = motor.end_s if math.isfinite(motor.end_s) else begun_s + ENDLESS_MOVE_S
                moment_s = max(moment_s, 0.5 * (begun_s + end_s)) if motor.is_moving else math.inf
            found.append((fault.number, moment_s))
        return found

    def _reset_moments_s(self, until_s: float) -> list[float]:
        if not self.faults.of("drive_reset"):
            return []
        moments = (moment_s for leg in self._motors for _, moment_s in self._pending_resets(leg))
        return [moment_s for moment_s in moments if self._now_s < moment_s < until_s]

    def _motor_travel_m(self, driven: Leg) -> float:
        """Travel that a motor has brought about since `_regear` last changed anything."""
        steps = self._motors[driven].true_leg_steps - self._base_leg_steps[driven]
        return self._gearing[driven].factor * steps / self._per_m[driven]

    def _regear(self) -> None:
        gearing = true_gearing(self._motors, self.faults, self._now_s)
        if gearing == self._gearing:
            return
        self._base_travel_m = {leg: self.travel_m(leg) for leg in self._motors}
        self._base_leg_steps = {leg: motor.true_leg_steps for leg, motor in self._motors.items()}
        self._gearing = gearing
        self._driven_by = {geared.leg: leg for leg, geared in gearing.items()}
