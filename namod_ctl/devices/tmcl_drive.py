"""A leg on a motor of a TMCL module.

TMCL has no flag for "the position refers to the reference switch". This driver keeps one in a user variable of the
module, which is lost when the module resets: "seeking" when a search begins, "homed" when the search has ended and the
variable still says "seeking". A program that starts anew, or a reset in the middle of a search or of a move, therefore
never finds a drive homed that is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from firmware_protocols import tmcl
from firmware_protocols.tmcl import AxisParameter, Command, ReferenceSearch
from namod_ctl.core.drives import DriveState
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.units import celsius_to_k
from namod_ctl.devices.links import TmclLink
from namod_ctl.devices.steps import StepScale

HOMED_VARIABLE = 64
"""User variable of motor 0's flag, the other motors' follow; from 56 on user variables live in RAM."""
HOMED, SEEKING = 1, 2

_N_READINGS = 5
_NOT_OFFERED = frozenset(
    {tmcl.Status.INVALID_COMMAND, tmcl.Status.WRONG_TYPE, tmcl.Status.INVALID_VALUE, tmcl.Status.COMMAND_NOT_AVAILABLE}
)


@dataclass(frozen=True, slots=True)
class ReferenceSearchSettings:
    """How a module seeks its reference.

    Attributes
    ----------
    mode
        Number of the search in the module's manual (axis parameter 193): which switch, from which side.
    search_speed_m_per_s
        Speed towards the switch.
    switch_speed_m_per_s
        Speed at which the edge of the switch is measured.
    """

    mode: int
    search_speed_m_per_s: float
    switch_speed_m_per_s: float


class TmclDrive:
    """One motor of one module.

    Parameters
    ----------
    link
        The module's line.
    module, motor
        Address on the line, and motor of the module from 0.
    steps_per_m, range_m
        See `StepScale`; steps are the module's microsteps.
    speed_m_per_s, acceleration_m_per_s2
        Of the leg. Sent in steps/s and steps/s2, as modules with ramps in real units take them.
    homing
        None leaves the search to the module's own settings.
    name
        For a person; None: from the address.
    """

    def __init__(
        self,
        link: TmclLink,
        module: int,
        motor: int,
        *,
        steps_per_m: float,
        range_m: tuple[float, float],
        speed_m_per_s: float,
        acceleration_m_per_s2: float,
        homing: ReferenceSearchSettings | None = None,
        name: str | None = None,
    ) -> None:
        self._link = link
        self._module = module
        self._motor = motor
        self._scale = StepScale(steps_per_m, range_m, tmcl.VALUE_MAX)
        self._speed = self._scale.magnitude(speed_m_per_s)
        self._acceleration = self._scale.magnitude(acceleration_m_per_s2)
        self._homing = homing
        self._name = name or f"TMCL module {module} motor {motor} on {link.name}"
        self._is_ordered = False
        self._is_seeking = False
        self._may_seek = True  # until a search has been stopped nobody knows: another program may have begun one
        self._was_homed = False
        self._not_offered: set[tuple[int, int]] = set()
        self._resting_temperature_k: float | None = None
        self._is_temperature_known = False

    @property
    def name(self) -> str:
        """Module, motor and line, for a person."""
        return self._name

    @property
    def range_m(self) -> tuple[float, float]:
        """Soft limits of the position."""
        return self._scale.range_m

    @property
    def resolution_m(self) -> float:
        """Travel of one microstep."""
        return self._scale.resolution_m

    def configure(self) -> None:
        """Tell the module the leg's speed and acceleration, before every search too: modules forget at a reset."""
        self._set_parameter(AxisParameter.MAX_SPEED, self._speed)
        self._set_parameter(AxisParameter.MAX_ACCELERATION, self._acceleration)
        if self._homing is not None:
            search_speed = self._scale.magnitude(self._homing.search_speed_m_per_s)
            switch_speed = self._scale.magnitude(self._homing.switch_speed_m_per_s)
            self._set_parameter(AxisParameter.REFERENCE_SEARCH_MODE, self._homing.mode)
            self._set_parameter(AxisParameter.REFERENCE_SEARCH_SPEED, search_speed)
            self._set_parameter(AxisParameter.REFERENCE_SWITCH_SPEED, switch_speed)

    def identity(self) -> str:
        """Model and firmware; TMCL knows no serial number."""
        return tmcl.firmware_text(self._value(Command.GET_FIRMWARE_VERSION, 1, 0))

    def state(self) -> DriveState:
        """The drive's state now. A standing drive's position is read until two readings agree.

        To keep the bus free, the temperature is read once in each rest, and the flag of a drive that was homed not
        while it moves: a reset brings it to rest.
        """
        if self._is_search_active():
            return DriveState(math.nan, is_moving=True, is_homed=False)
        is_reached = self._flag(AxisParameter.POSITION_REACHED)
        is_moving = not is_reached and self._parameter(AxisParameter.ACTUAL_SPEED) != 0
        faults: tuple[str, ...] = ()
        if not is_moving:
            faults = self._reported_faults()
            if not is_reached and self._is_ordered:
                faults += self._limit_faults()
                # nothing holds it, so it has not gathered speed yet
                is_moving = not faults
        is_homed = (is_moving and self._was_homed) or self._variable() == HOMED
        self._was_homed = is_homed
        steps = self._parameter(AxisParameter.ACTUAL_POSITION) if is_moving else self._standing_position()
        return DriveState(
            self._scale.position_m_at(steps) if is_homed else math.nan,
            is_moving,
            is_homed,
            faults,
            None if is_moving else self._temperature_k(),
        )

    def start_move(self, position_m: float) -> None:
        """Begin to move to an absolute position; the target is read back before it is believed."""
        steps = self._scale.steps_at(position_m, self._name)
        if self._may_seek:  # asked once: a stop then need not think of searches
            self._may_seek = bool(self._offered(Command.RFS, ReferenceSearch.STATUS, self._motor))
        self._is_ordered = True
        self._is_temperature_known = False
        for _ in range(_N_READINGS):
            self._value(Command.MVP, tmcl.MoveType.ABS, self._motor, steps)
            if self._parameter(AxisParameter.TARGET_POSITION) == steps:
                return
        self.stop()
        raise DeviceFaultError(f"{self._name} does not take {steps} steps as its target; it was stopped")

    def start_homing(self) -> None:
        """Begin the reference search; the drive is not homed until it has ended."""
        self.configure()
        self._is_seeking, self._may_seek, self._was_homed = False, True, False
        self._is_temperature_known = False
        self._set_variable(SEEKING)
        self._value(Command.RFS, ReferenceSearch.START, self._motor)
        # only now: a search that was never begun must not count as one that has ended
        self._is_seeking = True

    def stop(self) -> None:
        """Halt; a search that was under way leaves the drive not homed. The halt goes first: it is what counts."""
        self._is_ordered = False
        self._is_seeking = False
        try:
            self._value(Command.MST, 0, self._motor)
        finally:
            if self._may_seek:
                self._offered(Command.RFS, ReferenceSearch.STOP, self._motor)
                self._value(Command.MST, 0, self._motor)  # the search may have gone on in between
                self._may_seek = False

    def clear_faults(self) -> None:
        """Modules drop their error flags at the next motion command: a stop is the harmless one."""
        self.stop()

    def _is_search_active(self) -> bool:
        if not self._is_seeking:
            return False
        if self._value(Command.RFS, ReferenceSearch.STATUS, self._motor) != 0:
            return True
        self._is_seeking = False
        # a search that gave up has ended too, but not at the reference
        is_found = self._flag(AxisParameter.POSITION_REACHED) and not self._reported_faults()
        if is_found and self._variable() == SEEKING:
            self._set_variable(HOMED)
        return False

    def _limit_faults(self) -> tuple[str, ...]:
        """The limit switch that stands in the way to the target; the one at the other end is no hindrance."""
        way = self._parameter(AxisParameter.TARGET_POSITION) - self._parameter(AxisParameter.ACTUAL_POSITION)
        if way > 0:
            return ("right limit switch hit",) if self._flag(AxisParameter.RIGHT_LIMIT_SWITCH) else ()
        return ("left limit switch hit",) if self._flag(AxisParameter.LEFT_LIMIT_SWITCH) else ()

    def _reported_faults(self) -> tuple[str, ...]:
        found = []
        for parameter, words in (
            (AxisParameter.EXTENDED_ERROR_FLAGS, tmcl.EXTENDED_ERROR_WORDS),
            (AxisParameter.DRIVER_ERROR_FLAGS, tmcl.DRIVER_ERROR_WORDS),
        ):
            bits = self._offered(Command.GAP, parameter, self._motor) or 0
            found += [text for bit, text in words.items() if bits >> bit & 1]
        return tuple(found)

    def _temperature_k(self) -> float | None:
        if not self._is_temperature_known:
            celsius = self._offered(Command.GIO, tmcl.TEMPERATURE_PORT, tmcl.ANALOG_BANK)
            self._resting_temperature_k = None if celsius is None else celsius_to_k(float(celsius))
            self._is_temperature_known = True
        return self._resting_temperature_k

    def _standing_position(self) -> int:
        """Two equal readings: the sum of a frame misses some pairs of wrong bits, and legs are judged by it."""
        last = self._parameter(AxisParameter.ACTUAL_POSITION)
        for _ in range(_N_READINGS):
            now = self._parameter(AxisParameter.ACTUAL_POSITION)
            if now == last:
                break
            last = now
        return last

    def _flag(self, parameter: AxisParameter) -> bool:
        for _ in range(_N_READINGS):
            value = self._parameter(parameter)
            if value in (0, 1):
                return value == 1
        raise CommunicationError(f"{self._name}: parameter {parameter.name} is {value}, expected 0 or 1")

    def _variable(self) -> int:
        """The homed flag. One that is not set is read twice: a pair of wrong bits must not take a drive's home away."""
        value = self._variable_once()
        return value if value == HOMED else self._variable_once()

    def _variable_once(self) -> int:
        return self._value(Command.GGP, HOMED_VARIABLE + self._motor, tmcl.USER_BANK)

    def _set_variable(self, value: int) -> None:
        self._value(Command.SGP, HOMED_VARIABLE + self._motor, tmcl.USER_BANK, value)

    def _parameter(self, parameter: AxisParameter) -> int:
        return self._value(Command.GAP, parameter, self._motor)

    def _set_parameter(self, parameter: AxisParameter, value: int) -> None:
        self._value(Command.SAP, parameter, self._motor, value)

    def _offered(self, command: Command, type_: int, motor: int) -> int | None:
        """The value, or None from modules that do not have it; asked once."""
        if (command, type_) in self._not_offered:
            return None
        reply = self._link.exchange(tmcl.Request(self._module, command, type_, motor))
        if reply.status in _NOT_OFFERED:
            self._not_offered.add((command, type_))
            return None
        return self._accepted(reply, command, type_)

    def _value(self, command: Command, type_: int, motor: int, value: int = 0) -> int:
        reply = self._link.exchange(tmcl.Request(self._module, command, type_, motor, value))
        return self._accepted(reply, command, type_)

    def _accepted(self, reply: tmcl.Reply, command: Command, type_: int) -> int:
        if reply.status != tmcl.Status.OK:
            raise DeviceFaultError(
                f"{self._name} refuses {command.name} {type_}: {tmcl.status_words(reply.status)} ({reply.status})"
            )
        return reply.value
