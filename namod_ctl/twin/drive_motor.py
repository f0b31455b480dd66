"""The motor and spindle of one leg, as they are: ramps, switches, play, lost steps, warmth. Knows no wire and no clock.

Three places of one drive, all in steps: the *count* of its electronics, the *spindle* (0 where the reference switch
changes), and the *leg*, which follows the spindle when the play between them is taken up. Steps that are lost, and a
count that is lost by a reset, are differences between count and spindle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from namod_ctl.twin.drive_ramp import Piece, plan_move, plan_speed
from namod_ctl.twin.drive_settings import MotorSettings

REFERENCE_OVERRUN_STEPS = 50.0
"""The reference is always passed upwards, from this far below: play and hysteresis of the switch cancel."""
SLOW_SHARE = 0.25
"""Of the homing speed, over the reference switch."""
SEARCH_SHARE = 1.2
"""Of the way between the limit switches: after so much without a switch a search for the reference has failed."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """What faults do to a motor for a while.

    Attributes
    ----------
    lost_share
        Of its steps; 1: the spindle stands.
    backlash_factor
        By how much the play has grown.
    is_low_limit_stuck, is_high_limit_stuck
        A limit switch that tells the end of the way where there is none.
    """

    lost_share: float = 0.0
    backlash_factor: float = 1.0
    is_low_limit_stuck: bool = False
    is_high_limit_stuck: bool = False


HEALTHY = Conditions()


class Phase(Enum):
    """What a motor is doing."""

    REST = "rest"
    MOVE = "move"
    ROTATE = "rotate"
    STOP = "stop"
    SEEK_BELOW = "home: below the reference"
    SEEK_UP = "home: up to the reference"


class MotorFault(Enum):
    """What stopped a motor; its electronics tell it in their own way, until it is cleared or a new order comes."""

    LOW_LIMIT = "lower limit switch"
    HIGH_LIMIT = "upper limit switch"
    FOLLOWING_ERROR = "following error"
    NO_REFERENCE = "reference switch not found"


Note = Callable[[float, str, float, float], None]
"""Told at a moment (s): an order or an event, and from and to which count (steps); "arrived": of the spindle."""


class DriveMotor:
    """One motor. Call `update` with a moment before asking or ordering anything at that moment.

    `start_steps` is where the spindle stands at the clock's zero, from the reference; a drive that is homed counts it.
    """

    def __init__(self, settings: MotorSettings, start_steps: int = 0, is_homed: bool = True, note: Note | None = None):
        self.settings = settings
        self.is_homed = is_homed
        self.faults: frozenset[MotorFault] = frozenset()
        self.conditions = HEALTHY
        self.n_resets = 0
        per_m = settings.steps_per_m
        self.max_speed = settings.max_speed_m_per_s * per_m
        self.max_acceleration = settings.max_acceleration_m_per_s2 * per_m
        self._homing_speed = settings.homing_speed_m_per_s * per_m
        self._limits = (settings.limits_m[0] * per_m, settings.limits_m[1] * per_m)
        self._lag_s = settings.following_lag_s if settings.has_encoder else 0.0
        self._now_s = 0.0
        self._count = float(start_steps if is_homed else 0)
        self._spindle = float(start_steps)
        self._encoder_zero = float(start_steps) - self._count
        self._leg = float(start_steps)
        self._warmth_k = 0.0
        self._pieces: tuple[Piece, ...] = ()
        self._phase = Phase.REST
        self._target = self._count
        self._from_spindle = self._spindle
        self._search_end = 0.0
        self._note = note

    # --- what it tells

    @property
    def count(self) -> int:
        """The count of its electronics."""
        return round(self._count)

    @property
    def position(self) -> int:
        """Where it says it is: by its encoder if it has one, else its count."""
        return round(self._count - self._following_error()) if self.settings.has_encoder else self.count

    @property
    def target(self) -> int:
        """Where the last order sends it."""
        return round(self._target)

    @property
    def speed(self) -> float:
        """Steps per second at present."""
        return self._pieces[0].speed_at(self._now_s) if self._pieces else 0.0

    @property
    def phase(self) -> Phase:
        """What it is doing at present."""
        return self._phase

    @property
    def is_moving(self) -> bool:
        """Is it under way?"""
        return self._phase is not Phase.REST

    @property
    def is_homing(self) -> bool:
        """Does it search its reference?"""
        return self._phase in (Phase.SEEK_BELOW, Phase.SEEK_UP)

    @property
    def following_error(self) -> int:
        """Count less encoder, steps; 0 without an encoder."""
        return round(self._following_error()) if self.settings.has_encoder else 0

    @property
    def is_at_low_limit(self) -> bool:
        """What the lower limit switch says."""
        return self._spindle <= self._limits[0] or self.conditions.is_low_limit_stuck

    @property
    def is_at_high_limit(self) -> bool:
        """What the upper limit switch says."""
        return self._spindle >= self._limits[1] or self.conditions.is_high_limit_stuck

    @property
    def is_below_reference(self) -> bool:
        """What the reference switch says."""
        return self._spindle < 0.0

    @property
    def temperature_k(self) -> float:
        """Of the motor."""
        return self.settings.ambient_k + self._warmth_k

    @property
    def true_spindle_steps(self) -> float:
        """Where the spindle really is, from the reference."""
        return self._spindle

    @property
    def true_leg_steps(self) -> float:
        """Where the leg really is, from the reference."""
        return self._leg

    @property
    def end_s(self) -> float:
        """When the present motion will have ended if nothing happens; infinite where that is not known."""
        if self.is_homing:
            return math.inf
        return self._pieces[-1].end_s if self._pieces else self._now_s

    # --- orders, at the moment of the last update

    def start_move(self, target: int, speed: float, acceleration: float) -> None:
        """Begin to move to a count, with a speed and an acceleration (steps, s) of at most what the motor can do."""
        self._begin(Phase.MOVE, "move", target)
        self._pieces = plan_move(self._now_s, self._count, self.speed, float(target), speed, acceleration)
        self._rest_when_done()

    def start_rotation(self, speed: float, acceleration: float) -> None:
        """Turn with a speed (steps per s, with sign) until something stops it."""
        self._begin(Phase.ROTATE, "rotate", math.copysign(math.inf, speed) if speed else self._count)
        self._pieces = plan_speed(self._now_s, self._count, self.speed, speed, acceleration)
        self._rest_when_done()

    def start_homing(self) -> None:
        """Search the reference switch, from either side; then the count is 0 there."""
        self._begin(Phase.SEEK_BELOW, "home", 0.0)
        self.is_homed = False
        self._seek(Phase.SEEK_BELOW, -self._homing_speed)

    def stop(self, acceleration: float) -> None:
        """Halt with that deceleration, steps per s^2."""
        if not self.is_moving:
            return
        self._tell("stop", self._count, self._count)
        self._phase = Phase.STOP
        self._pieces = plan_speed(self._now_s, self._count, self.speed, 0.0, acceleration)
        if self._pieces:
            self._target = self._pieces[-1].position_at(self._pieces[-1].end_s)
        self._rest_when_done()

    def set_count(self, count: int) -> None:
        """Call the place where it stands `count`."""
        shift = count - self._count
        self._count += shift
        self._encoder_zero -= shift
        self._target = self._count

    def reset(self) -> None:
        """Lose power for a moment: it stops, has forgotten where it is, and what was wrong."""
        count = self._spindle if self.settings.is_absolute else 0.0
        self._tell("reset", self._count, count)
        self._phase, self._pieces = Phase.REST, ()
        self._count = self._target = count
        self._encoder_zero = self._spindle - count
        self.is_homed = self.settings.is_absolute
        self.faults = frozenset()
        self.n_resets += 1

    def clear_faults(self) -> None:
        """Forget what stopped it."""
        self.faults = frozenset()

    # --- physics

    def update(self, time_s: float) -> None:
        """Move until `time_s`, under the same conditions all the while. Nothing if that is over."""
        while self._now_s < time_s:
            if not self.is_moving:
                self._warm(time_s, 0.0)
                break
            piece = self._pieces[0]
            if self._blocks(piece):
                self._halt(MotorFault.HIGH_LIMIT if self._rises(piece) else MotorFault.LOW_LIMIT)
                continue
            end_s = min(time_s, piece.end_s)
            way = self._target - self._count if self._is_last_of_move(piece, end_s) else None
            self._follow(piece, end_s, way)

    def _follow(self, piece: Piece, end_s: float, way: float | None) -> None:
        """Go along a piece until `end_s` or until something on the way ends it."""
        way = piece.position_at(end_s) - self._count if way is None else way
        obstacle = self._obstacle(self._rises(piece), abs(way))
        if obstacle is not None:
            distance, event = obstacle
            way = math.copysign(distance, way)
            end_s = min(max(piece.time_of(self._count + way), self._now_s), end_s)
        self._count += way
        self._spindle += way * (1.0 - self.conditions.lost_share)
        play = 0.5 * self.settings.backlash_m * self.settings.steps_per_m * self.conditions.backlash_factor
        self._leg = min(max(self._leg, self._spindle - play), self._spindle + play)
        self._warm(end_s, self.settings.heating_k)
        if obstacle is not None:
            self._meet(event)
        elif end_s >= piece.end_s:
            self._pieces = self._pieces[1:]
            self._rest_when_done()

    def _obstacle(self, is_rising: bool, way: float) -> tuple[float, MotorFault | None] | None:
        """What ends a way of so many counts early: after how many, and the fault; None where homing has got there."""
        direction = 1.0 if is_rising else -1.0
        gain = 1.0 - self.conditions.lost_share
        found: list[tuple[float, MotorFault | None]] = []

        def add(spindle: float, event: MotorFault | None) -> None:
            room = direction * (spindle - self._spindle)
            if gain > 0.0 and 0.0 <= room <= way * gain:
                found.append((room / gain, event))

        add(self._limits[is_rising], MotorFault.HIGH_LIMIT if is_rising else MotorFault.LOW_LIMIT)
        if self._phase is Phase.SEEK_BELOW:
            add(-REFERENCE_OVERRUN_STEPS, None)
        if self._phase is Phase.SEEK_UP:
            add(0.0, None)
        if self.is_homing and direction * (self._search_end - self._count) <= way:
            found.append((max(direction * (self._search_end - self._count), 0.0), MotorFault.NO_REFERENCE))
        if self.settings.has_encoder and self.conditions.lost_share > 0.0 and not self.is_homing:
            limit = self.settings.max_following_error_m * self.settings.steps_per_m
            room = max(limit - direction * (self._count - self._spindle + self._encoder_zero), 0.0)
            if room <= way * self.conditions.lost_share:
                found.append((room / self.conditions.lost_share, MotorFault.FOLLOWING_ERROR))
        return min(found, key=lambda each: each[0], default=None)

    def _meet(self, event: MotorFault | None) -> None:
        if event is not None:
            self._halt(event)
        elif self._phase is Phase.SEEK_BELOW:
            self._seek(Phase.SEEK_UP, SLOW_SHARE * self._homing_speed)
        else:
            self._spindle = 0.0
            self._count = self._target = self._encoder_zero = 0.0
            self.is_homed = True
            self._rest()

    def _seek(self, phase: Phase, speed: float) -> None:
        self._phase = phase
        if phase is Phase.SEEK_BELOW and self._spindle <= -REFERENCE_OVERRUN_STEPS:
            speed, self._phase = -SLOW_SHARE * speed, Phase.SEEK_UP
            if self._spindle < -2.0 * REFERENCE_OVERRUN_STEPS:
                speed /= SLOW_SHARE  # a long way: a switch that is passed fast is as good here
        way = SEARCH_SHARE * (self._limits[1] - self._limits[0])
        self._search_end = self._count + math.copysign(way, speed)
        self._pieces = plan_speed(self._now_s, self._count, 0.0, speed, self.max_acceleration)

    def _begin(self, phase: Phase, order: str, target: float) -> None:
        self._tell(order, self._count, target)
        if not self.is_moving:
            self._from_spindle = self._spindle
        self.faults = frozenset()
        self._phase, self._target = phase, target

    def _halt(self, fault: MotorFault) -> None:
        """Stand at once."""
        self.faults = self.faults | {fault}
        self._tell(fault.value, self._count, self._count)
        if fault is MotorFault.FOLLOWING_ERROR:
            self._count = self._spindle - self._encoder_zero  # the loop was open: it takes over the encoder's word
        self._target = self._count
        self._rest()

    def _rest_when_done(self) -> None:
        if not self._pieces:
            if self._phase is Phase.ROTATE:
                self._target = self._count
            self._rest()

    def _rest(self) -> None:
        self._phase, self._pieces = Phase.REST, ()
        self._tell("arrived", self._from_spindle, self._spindle)

    def _is_last_of_move(self, piece: Piece, end_s: float) -> bool:
        """Ends the motion here? Then it ends on its target, without errors of rounding."""
        return self._phase in (Phase.MOVE, Phase.STOP) and len(self._pieces) == 1 and end_s >= piece.end_s

    def _rises(self, piece: Piece) -> bool:
        return piece.speed > 0.0 or (piece.speed == 0.0 and piece.acceleration > 0.0)

    def _blocks(self, piece: Piece) -> bool:
        """Does a limit switch forbid the direction?"""
        return self.is_at_high_limit if self._rises(piece) else self.is_at_low_limit

    def _following_error(self) -> float:
        return self._count - self._spindle + self._encoder_zero + self._lag_s * self.speed

    def _warm(self, time_s: float, heating_k: float) -> None:
        decay = math.exp(-(time_s - self._now_s) / self.settings.heating_s)
        self._warmth_k = heating_k + (self._warmth_k - heating_k) * decay
        self._now_s = time_s

    def _tell(self, what: str, start: float, end: float) -> None:
        if self._note is not None:
            self._note(self._now_s, what, start, end)
