"""Metres of a leg <-> steps of its drive, and the limits of both; what all drives that count steps share."""

from __future__ import annotations

import math
from dataclasses import dataclass

from namod_ctl.core.errors import ConfigError, LimitError
from namod_ctl.core.units import m_to_mm


@dataclass(frozen=True, slots=True)
class StepScale:
    """How a drive's steps lie along its leg.

    Attributes
    ----------
    steps_per_m
        Steps per metre of travel; negative where counting up makes the leg shorter.
    range_m
        Soft limits of the position, the drive's reference being 0.
    max_steps
        Largest number of steps, of either sign, that the protocol can express.

    Raises
    ------
    ConfigError
        The scale is 0 or no number, the range is inside out, or its ends do not fit the protocol.
    """

    steps_per_m: float
    range_m: tuple[float, float]
    max_steps: int

    def __post_init__(self) -> None:
        low_m, high_m = self.range_m
        if not math.isfinite(self.steps_per_m) or self.steps_per_m == 0.0:
            raise ConfigError(f"steps_per_m = {self.steps_per_m} of a drive: give a finite number other than 0")
        if not (math.isfinite(low_m) and math.isfinite(high_m) and low_m < high_m):
            raise ConfigError(f"range_m = [{low_m}, {high_m}] of a drive: the first must be below the second")
        largest = max(abs(low_m), abs(high_m)) * abs(self.steps_per_m)
        if largest > self.max_steps:
            raise ConfigError(
                f"range_m = [{low_m}, {high_m}] with steps_per_m = {self.steps_per_m} needs {largest:.0f} steps, the "
                f"drive counts to {self.max_steps}: check the two numbers"
            )

    @property
    def resolution_m(self) -> float:
        """Travel of one step."""
        return 1.0 / abs(self.steps_per_m)

    def steps_at(self, position_m: float, name: str) -> int:
        """The step nearest to a position.

        Raises
        ------
        LimitError
            The position is outside of the range, or not a number; `name` is the drive's.
        """
        low_m, high_m = self.range_m
        if not low_m <= position_m <= high_m:
            raise LimitError(
                f"{name}: position {m_to_mm(position_m):.4f} mm is outside of its range {m_to_mm(low_m):.4f} to "
                f"{m_to_mm(high_m):.4f} mm; nothing was sent"
            )
        return round(position_m * self.steps_per_m)

    def position_m_at(self, steps: int) -> float:
        """Position at a step."""
        return steps / self.steps_per_m

    def magnitude(self, rate_per_m: float) -> int:
        """A speed or acceleration in whole steps, not above what is asked, but at least 1: with 0 it never arrives."""
        return max(1, math.floor(rate_per_m * abs(self.steps_per_m)))
