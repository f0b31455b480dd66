"""Mounts of facets: tilts <-> travels of their legs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """The legs that carry one facet.

    Attributes
    ----------
    legs_m
        Shape (n_legs, 2). Where each leg meets the facet, relative to the facet's centre, telescope x and y.
    has_fixed_point
        True when a fixed joint at the facet's centre holds its height (two actuators and a fixed point).
    travel_limit_m
        Largest travel of one leg in one correction; a larger one is refused, never clipped.
    backlash_m
        Travel that is lost when a leg changes its direction.
    pitch_m_per_turn
        Travel of one bolt turn; None where legs are no bolts.
    turn_raises_leg
        The sense of turning, as seen by the person who turns, that moves a leg along +z.
    """

    legs_m: Array
    has_fixed_point: bool
    travel_limit_m: float
    backlash_m: float = 0.0
    pitch_m_per_turn: float | None = None
    turn_raises_leg: Literal["clockwise", "counterclockwise"] = "clockwise"
