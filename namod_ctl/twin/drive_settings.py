"""One drive of the twin as it was built."""

from __future__ import annotations

from dataclasses import dataclass

from namod_ctl.core.units import mm_to_m, um_to_m


@dataclass(frozen=True, slots=True)
class MotorSettings:
    """One drive as it was built.

    Attributes
    ----------
    steps_per_m
        Counts per travel of the leg, without sign: the default are steps of 3 um.
    max_speed_m_per_s, max_acceleration_m_per_s2
        The drive refuses more.
    homing_speed_m_per_s
        Of the search for the reference switch.
    limits_m
        The limit switches, from the reference.
    backlash_m
        Play between spindle and leg: so much travel is lost when the motor turns back.
    has_encoder
        An encoder on the spindle: the position that is told is the spindle's, and a spindle that does not follow is
        noticed. Without one, the count is told.
    is_absolute
        The encoder knows the place at once when power comes back: such a drive is always homed.
    max_following_error_m, following_lag_s
        Of a drive with an encoder: where it gives up, and by how much time the spindle trails the ramp.
    heating_k, heating_s
        How much warmer than `ambient_k` a motor gets that never rests, and how fast.
    """

    steps_per_m: float = 1.0 / um_to_m(3.0)
    max_speed_m_per_s: float = mm_to_m(1.0)
    max_acceleration_m_per_s2: float = mm_to_m(5.0)
    homing_speed_m_per_s: float = mm_to_m(0.5)
    limits_m: tuple[float, float] = (mm_to_m(-10.0), mm_to_m(10.0))
    backlash_m: float = um_to_m(10.0)
    has_encoder: bool = False
    is_absolute: bool = False
    max_following_error_m: float = um_to_m(60.0)
    following_lag_s: float = 0.002
    ambient_k: float = 283.15
    heating_k: float = 30.0
    heating_s: float = 600.0


PLAIN_MOTOR = MotorSettings()
"""An open-loop stepper drive with steps of 3 um."""
