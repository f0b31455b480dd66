"""A leg on a drive that speaks Modbus: a register map says what its registers mean and how it is moved."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable

from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError
from firmware_protocols.modbus_drive import (
    Condition,
    ReadBlock,
    Register,
    RegisterMap,
    RunUnless,
    WaitFor,
    WriteConstant,
    WritePosition,
    WriteTarget,
)
from namod_ctl.core.drives import DriveState
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.modbus_link import ModbusLink
from namod_ctl.devices.steps import StepScale

_MAX_COUNT = 2**32 - 1  # no register type counts further; whether the map's own does is checked with the range
_FLOAT32_STEP = 2.0**-23  # relative distance of neighbouring float32 numbers


class ModbusDrive:
    """One unit on one line.

    Parameters
    ----------
    link, unit
        The line, and the unit's address on it.
    register_map
        What its registers mean.
    steps_per_m, range_m
        See `StepScale`. For a map in metres a step is one count of the target register (its `scale`, in metres).
    speed_m_per_s, acceleration_m_per_s2
        Of the leg; told to the drive where its map has registers for them.
    name
        For a person; None: from the address.

    Raises
    ------
    ConfigError
        The range does not fit the target register, or speed or acceleration do not fit theirs.
    """

    def __init__(
        self,
        link: ModbusLink,
        unit: int,
        register_map: RegisterMap,
        *,
        steps_per_m: float,
        range_m: tuple[float, float],
        speed_m_per_s: float,
        acceleration_m_per_s2: float,
        name: str | None = None,
    ) -> None:
        self._link = link
        self._unit = unit
        self._map = register_map
        self._target = register_map.registers[register_map.target]
        self._scale = StepScale(steps_per_m, range_m, _MAX_COUNT)
        self._name = name or f"Modbus unit {unit} on {link.name}"
        in_steps = register_map.position_unit == "steps"
        self._unit_per_step = 1.0 if in_steps else abs(self._target.scale)
        for end_m in range_m:
            self._fits(self._target, self._value_at(end_m), "range_m")
        self._rates = {
            name: self._rate(register_map.registers[name], rate_per_m)
            for names, rate_per_m in (
                (() if register_map.speed is None else (register_map.speed,), speed_m_per_s),
                (register_map.accelerations, acceleration_m_per_s2),
            )
            for name in names
        }
        self._state_conditions = [
            condition
            for condition in register_map.conditions.values()
            if condition.fault is not None or condition.name in ("moving", "homed")
        ]
        self._condition_blocks = register_map.reads(
            term.register for condition in register_map.conditions.values() for term in condition.terms
        )
        self._resting_temperature_k: float | None = None
        self._is_temperature_known = False

    @property
    def name(self) -> str:
        """Unit and line, for a person."""
        return self._name

    @property
    def range_m(self) -> tuple[float, float]:
        """Soft limits of the position."""
        return self._scale.range_m

    @property
    def resolution_m(self) -> float:
        """Travel of one count of the target register."""
        if self._target.type == "float32":
            return max(map(abs, self.range_m)) * _FLOAT32_STEP
        per_count = abs(self._target.scale) / self._unit_per_step
        return per_count * self._scale.resolution_m

    def configure(self) -> None:
        """Tell the drive the leg's speed and acceleration and what its map adds; before every homing too."""
        for name, raw in self._rates.items():
            self._write(self._map.registers[name], raw)
        if "configure" in self._map.sequences:
            self._run("configure")

    def identity(self) -> str:
        """What the map's identity registers hold; without any, only that there is something that answers."""
        raws = self._read(self._map.identity or [self._map.position])
        return ", ".join([self._map.name, *(f"{name} {raws[name]:g}" for name in self._map.identity)])

    def state(self) -> DriveState:
        """The drive's state now; its temperature as it came to rest, read once in each rest, to keep the bus free."""
        names = {term.register for condition in self._state_conditions for term in condition.terms}
        names.add(self._map.position)
        if "moving" not in self._map.conditions:
            names.add(self._map.target_readback)
        raws = self._read(names)
        position = self._map.registers[self._map.position].value_of(raws[self._map.position])
        if "moving" in self._map.conditions:
            is_moving = self._map.conditions["moving"].holds(raws)
        else:
            target = self._map.registers[self._map.target_readback].value_of(raws[self._map.target_readback])
            is_moving = abs(target - position) > (self._map.reached_within or 0.0)
        is_homed = not self._map.has_homing or self._map.conditions["homed"].holds(raws)
        return DriveState(
            position / (self._scale.steps_per_m * self._unit_per_step) if is_homed else math.nan,
            is_moving,
            is_homed,
            self._faults(raws),
            None if is_moving else self._temperature_k(),
        )

    def start_move(self, position_m: float) -> None:
        """Begin to move to an absolute position; the drive must show the target before the move is believed.

        Raises
        ------
        DeviceFaultError
            Besides what `Drive` says: the drive is not homed, so it does not know where the position is.
        """
        self._scale.steps_at(position_m, self._name)
        raws = self._read_conditions("fault", "homed")
        if not self._check_ready(raws):
            raise DeviceFaultError(f"{self._name} is not homed (was it without power?): home it before it is moved")
        self._is_temperature_known = False
        self._run("move", self._target.raw_of(self._value_at(position_m)), raws)

    def start_homing(self) -> None:
        """Begin to seek the reference; nothing to do for drives that need none."""
        if self._map.has_homing:
            self._check_ready(self._read_conditions("fault", "homed"))
            self._is_temperature_known = False
            self.configure()
            self._run("home")

    def stop(self) -> None:
        """Halt."""
        self._run("stop")

    def clear_faults(self) -> None:
        """Acknowledge faults where the drive has a way to."""
        if "clear_faults" in self._map.sequences:
            self._run("clear_faults")

    def _value_at(self, position_m: float) -> float:
        return position_m * self._scale.steps_per_m * self._unit_per_step

    def _rate(self, register: Register, rate_per_m: float) -> float:
        value = rate_per_m * abs(self._scale.steps_per_m) * self._unit_per_step
        raw = self._fits(register, value, "speed or acceleration")
        return raw if register.type == "float32" else max(raw, 1)  # with 0 a drive would never arrive

    def _fits(self, register: Register, value: float, key: str) -> float:
        try:
            raw = register.raw_of(value)
            register.encode_raw(raw)
        except LocalProtocolError as problem:
            raise ConfigError(
                f"{self._name}: {key} and steps_per_m = {self._scale.steps_per_m} do not fit the drive "
                f"({self._map.name}): {problem}"
            ) from None
        return raw

    def _check_ready(self, raws: dict[str, float]) -> bool:
        """Whether it is homed. Raises DeviceFaultError while a fault must be cleared first."""
        known = self._map.conditions
        if "fault" in known and known["fault"].holds(raws):
            raise DeviceFaultError(f"{self._name}: {self._fault_words(known['fault'])}; clear its faults first")
        return not self._map.has_homing or known["homed"].holds(raws)

    def _run(self, sequence: str, target_raw: float | None = None, seen: dict[str, float] | None = None) -> None:
        """Do what a sequence of the map says. What was `seen` since the last write is not asked again."""
        seen = dict(seen or {})
        for step in self._map.sequences[sequence]:
            if isinstance(step, WaitFor | RunUnless):
                condition = step.condition if isinstance(step, WaitFor) else step.unless
                if any(term.register not in seen for term in self._map.conditions[condition].terms):
                    seen |= self._read_conditions(condition)
            match step:
                case WriteConstant():
                    self._write(self._map.registers[step.register], step.raw)
                case WriteTarget() if target_raw is not None:
                    self._write_target(target_raw)
                case WritePosition():
                    position = self._map.registers[self._map.position]
                    here = position.value_of(self._read([position.name])[position.name])
                    self._write(self._target, self._target.raw_of(here))
                case WaitFor():
                    seen = self._wait(step, seen)
                    continue
                case RunUnless() if not self._map.conditions[step.unless].holds(seen):
                    self._run(step.sequence)
                case RunUnless():
                    continue
            seen = {}

    def _write_target(self, raw: float) -> None:
        """Give the target; a drive that understood another one is stopped."""
        self._write(self._target, raw)
        readback = self._map.registers[self._map.target_readback]
        understood = readback.value_of(self._read([readback.name])[readback.name])
        asked = self._target.value_of(self._target.decode_raw(self._target.encode_raw(raw)))
        tolerance = 0.0 if readback.type == "float32" else abs(readback.scale) / 2.0
        if abs(understood - asked) > tolerance:
            self.stop()
            raise DeviceFaultError(
                f"{self._name} was given the target {asked:g} {self._target.unit} and shows {understood:g}; "
                "it was stopped. Check its own limits and its register map"
            )

    def _wait(self, step: WaitFor, seen: dict[str, float]) -> dict[str, float]:
        """What was seen last, when it is as it should be; `seen` is the first look."""
        condition = self._map.conditions[step.condition]
        deadline_s = time.monotonic() + step.timeout_s
        while condition.holds(seen) != step.holds:
            if time.monotonic() > deadline_s:
                faults = "; ".join(self.state().faults) or "it reports no fault"
                wanted = condition.name if step.holds else f"not {condition.name}"
                raise DeviceFaultError(f"{self._name} is not '{wanted}' after {step.timeout_s:g} s: {faults}")
            seen = self._read_conditions(condition.name)  # an exchange, which takes its time on the line
        return seen

    def _read_conditions(self, *names: str) -> dict[str, float]:
        """What these conditions look at, and what stands in the same requests: the next step may want it."""
        known = [self._map.conditions[name] for name in names if name in self._map.conditions]
        wanted = {term.register for condition in known for term in condition.terms}
        return self._read_blocks(block for block in self._condition_blocks if not wanted.isdisjoint(block.names))

    def _faults(self, raws: dict[str, float]) -> tuple[str, ...]:
        return tuple(
            self._fault_words(condition)
            for condition in self._state_conditions
            if condition.fault is not None and condition.holds(raws)
        )

    def _fault_words(self, condition: Condition) -> str:
        codes = self._map.fault_codes
        words = condition.fault or condition.name
        if codes is None or condition.name != "fault":
            return words
        raw = self._read([codes.register])[codes.register]
        return f"{words}, {codes.describe(raw)}" if raw else words

    def _temperature_k(self) -> float | None:
        name = self._map.temperature
        if name is not None and not self._is_temperature_known:
            self._resting_temperature_k = self._map.registers[name].value_of(self._read([name])[name])
            self._is_temperature_known = True
        return self._resting_temperature_k

    def _read(self, names: Iterable[str]) -> dict[str, float]:
        """Raw values by name."""
        return self._read_blocks(self._map.reads(names))

    def _read_blocks(self, blocks: Iterable[ReadBlock]) -> dict[str, float]:
        raws: dict[str, float] = {}
        for block in blocks:
            words = self._link.read(self._unit, block.function, block.address, block.count)
            try:
                raws |= self._map.decode_block(block, words)
            except RemoteProtocolError as problem:
                raise CommunicationError(f"{self._name}: {problem}; check its register map") from None
        return raws

    def _write(self, register: Register, raw: float) -> None:
        if register.write is None:
            raise TypeError(f"the map of {self._name} lets register {register.name} not be written")
        self._link.write(self._unit, register.write, register.address, register.encode_raw(raw))
