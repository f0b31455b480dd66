"""How legs are moved: the settings that preview, motion and self-test share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """How legs are moved, in SI units.

    Attributes
    ----------
    max_travel_per_cycle_m
        No leg may be sent further than this from where it stands, in one cycle; a larger correction is refused.
    approach_m
        One-sided approach: every target is reached in +z. A leg that would come from above first goes this much below
        its target, so that the play of spindle and leg always lies on the same side. 0: straight to the target.
    arrival_tolerance_m
        A leg has arrived when its readback is within this of its target.
    settle_s
        So long a leg stands before its readback counts.
    poll_s
        So often a moving drive is asked for its state.
    speed_m_per_s
        Of the legs on their way: what the longest time of a motion is reckoned from.
    """

    max_travel_per_cycle_m: float
    approach_m: float
    arrival_tolerance_m: float
    settle_s: float
    poll_s: float
    speed_m_per_s: float
