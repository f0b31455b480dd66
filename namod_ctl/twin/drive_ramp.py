"""Trapezoidal motion of a motor in closed form: where it is at any moment, without steps of time."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Piece:
    """Motion with constant acceleration in one direction (steps, seconds); its speed never changes sign."""

    start_s: float
    end_s: float
    position: float
    speed: float
    acceleration: float

    def position_at(self, time_s: float) -> float:
        """Steps at a moment within the piece."""
        passed_s = time_s - self.start_s
        return self.position + (self.speed + 0.5 * self.acceleration * passed_s) * passed_s

    def speed_at(self, time_s: float) -> float:
        """Steps per second at a moment within the piece."""
        return self.speed + self.acceleration * (time_s - self.start_s)

    def time_of(self, position: float) -> float:
        """The moment at which a position on the piece's way is passed."""
        way = position - self.position
        if way == 0.0:
            return self.start_s
        speed_there = math.sqrt(max(self.speed**2 + 2.0 * self.acceleration * way, 0.0))
        return self.start_s + 2.0 * way / (self.speed + math.copysign(speed_there, way))


def plan_move(
    start_s: float, position: float, speed: float, target: float, max_speed: float, acceleration: float
) -> tuple[Piece, ...]:
    """The fastest way to rest at `target` from any speed, pieces one after the other; empty when it rests there.

    A motor that runs the wrong way, or too fast to stop in time, stops and turns first.
    """
    pieces: list[Piece] = []
    way_to_stop = speed * abs(speed) / (2.0 * acceleration)
    direction = math.copysign(1.0, target - position - way_to_stop)
    if speed * direction < 0.0:
        pieces.append(_slowed(start_s, position, speed, 0.0, acceleration))
        start_s, position, speed = pieces[-1].end_s, position + way_to_stop, 0.0
    way, now = abs(target - position), abs(speed)
    peak = min(max_speed, math.sqrt(acceleration * way + 0.5 * now**2))
    if peak != now:
        pieces.append(_slowed(start_s, position, direction * now, direction * peak, acceleration))
        position = pieces[-1].position_at(pieces[-1].end_s)
        start_s = pieces[-1].end_s
    braking = peak**2 / (2.0 * acceleration)
    cruise = direction * (target - position) - braking
    if peak > 0.0:
        if cruise > 0.0 and peak == max_speed:
            pieces.append(Piece(start_s, start_s + cruise / peak, position, direction * peak, 0.0))
            start_s, position = pieces[-1].end_s, target - direction * braking
        pieces.append(_slowed(start_s, position, direction * peak, 0.0, acceleration))
    return tuple(piece for piece in pieces if piece.end_s > piece.start_s)


def plan_speed(
    start_s: float, position: float, speed: float, new_speed: float, acceleration: float
) -> tuple[Piece, ...]:
    """From one speed to another, and on with that for ever unless it is 0."""
    pieces: list[Piece] = []
    for goal in (0.0, new_speed) if speed * new_speed < 0.0 else (new_speed,):
        if goal != speed:
            pieces.append(_slowed(start_s, position, speed, goal, acceleration))
            start_s, speed = pieces[-1].end_s, goal
            position = pieces[-1].position_at(start_s)
    if speed != 0.0:
        pieces.append(Piece(start_s, math.inf, position, speed, 0.0))
    return tuple(pieces)


def _slowed(start_s: float, position: float, speed: float, new_speed: float, acceleration: float) -> Piece:
    change = new_speed - speed
    return Piece(start_s, start_s + abs(change) / acceleration, position, speed, math.copysign(acceleration, change))
