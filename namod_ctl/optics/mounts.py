"""Mounts of facets: tilts <-> travels of their legs <-> turns of their bolts.

A tilt here is a change of the facet's normal, (Phi_x, Phi_y): the facet's plane, level before, then has the normal
(Phi_x, Phi_y, 1) / |..| in the telescope frame. A straight leg at p (a bolt, a linear actuator along z) then meets
the facet exactly -(Phi_x p_x + Phi_y p_y) higher; there is no small angle in that. Inclined legs change their length,
which follows from the whole pose of the facet.

Motions that do not move the image are free: the height of the facet (piston), for inclined legs also its shift
along x and y and its turn about its normal. They are chosen so that the sum of the squares of all travels is least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import m_to_mm, rad_to_deg
from namod_ctl.optics.coordinates import rotation_to_normal

Array = NDArray[np.float64]

# Legs count as unable to hold the facet when a motion of it moves them by less than this share of what other
# motions of the same size do: the travels would then be dominated by play and by the tolerance of the drawing.
_LEAST_LEVERAGE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """The legs that carry one facet.

    Attributes
    ----------
    legs_m
        Shape (n_legs, 2). Where each leg meets the facet, relative to the facet's centre, telescope x and y.
    has_fixed_point
        True when a fixed joint at the facet's centre holds its height (two actuators and a fixed point); it also
        holds the facet against shifts and turns about its normal.
    travel_limit_m
        Largest travel of one leg in one correction; a larger one is refused, never clipped.
    backlash_m
        Travel that is lost when a leg changes its direction. Travels given here are those of the facet's end of
        the leg: backlash is not in them.
    pitch_m_per_turn
        Travel of one bolt turn; None where legs are no bolts.
    turn_raises_leg
        The sense of turning, as seen by the person who turns, that moves a leg along +z.
    base_joints_m
        Shape (n_legs, 3). For inclined legs (a hexapod) only: the fixed lower joint of each leg, relative to the
        facet's centre at rest in the plane of the upper joints (these are at z = 0); telescope x, y, z. A leg's
        travel is then its change of length. None: straight legs that move along z.
    """

    legs_m: Array
    has_fixed_point: bool
    travel_limit_m: float
    backlash_m: float = 0.0
    pitch_m_per_turn: float | None = None
    turn_raises_leg: Literal["clockwise", "counterclockwise"] = "clockwise"
    base_joints_m: Array | None = None

    def check_geometry(self, name: str) -> None:
        """Refuse legs that cannot hold or tilt the facet; `name` says which mount of which file it is.

        Raises
        ------
        ConfigError
            When there are too few legs, legs on one line, or legs that leave a motion of the facet free.
        """
        base = self.base_joints_m
        shape_is_right = self.legs_m.ndim == 2 and self.legs_m.shape[1] == 2 and len(self.legs_m) > 0
        if not shape_is_right or (base is not None and base.shape != (len(self.legs_m), 3)):
            raise ConfigError(
                f"{name}: each leg needs two coordinates where it meets the facet (x, y) and, when it is inclined, "
                f"three of its base joint (x, y, z); got shapes {self.legs_m.shape} and "
                f"{None if base is None else base.shape}"
            )
        if base is not None and np.any(np.linalg.norm(_upper_joints(self.legs_m) - base, axis=1) == 0.0):
            raise ConfigError(f"{name}: a leg of no length: its base joint lies where it meets the facet")
        leverage = self._leverage()
        n_legs, n_motions = leverage.shape
        if n_legs < n_motions:
            kind, held = "straight" if base is None else "inclined", "with" if self.has_fixed_point else "without"
            raise ConfigError(
                f"{name}: {n_legs} {kind} legs {held} a fixed point cannot hold a facet; "
                f"at least {n_motions} are needed"
            )
        strength = np.linalg.svd(leverage, compute_uv=False)
        if not strength[-1] > _LEAST_LEVERAGE * strength[0]:
            raise ConfigError(
                f"{name}: the legs leave a motion of the facet free (legs on one line, at one place, or a singular "
                f"hexapod): leverage {strength[-1] / strength[0] if strength[0] else 0.0:.1e} of the best motion, at "
                f"least {_LEAST_LEVERAGE:.0e} is needed; check the legs' positions"
            )

    def travel_of_tilt(self, tilt_rad: Array) -> Array:
        """Leg travels, shape (n_legs,), m, that change the facet's normal by `tilt_rad` (2,) with least total travel.

        NaN gives NaN. Straight legs: along +z. Inclined legs: change of length, from the exact pose.
        """
        if not np.all(np.isfinite(tilt_rad)):
            return np.full(len(self.legs_m), np.nan)
        base = self.base_joints_m
        if base is None:
            travel: Array = -self.legs_m @ tilt_rad
            return travel if self.has_fixed_point else travel - travel.mean()
        if self.has_fixed_point:
            return _length_change(self.legs_m, base, tilt_rad, np.zeros(4))
        best = least_squares(
            lambda free: _length_change(self.legs_m, base, tilt_rad, free), np.zeros(4), method="lm", xtol=1e-12
        )
        return _length_change(self.legs_m, base, tilt_rad, best.x)

    def tilt_of_travel(self, travel_m: Array) -> Array:
        """Change of the facet's normal, shape (2,), rad, when the legs have travelled `travel_m` (n_legs,).

        With more legs than a facet needs: the best fit of all of them. NaN gives NaN.
        """
        if not np.all(np.isfinite(travel_m)):
            return np.full(2, np.nan)
        base = self.base_joints_m
        if base is None:
            piston = np.ones((len(self.legs_m), 0 if self.has_fixed_point else 1))
            return np.asarray(np.linalg.lstsq(np.hstack([-self.legs_m, piston]), travel_m, rcond=None)[0][:2])
        n_free = 0 if self.has_fixed_point else 4

        def disagreement(pose: Array) -> Array:
            free = np.append(pose[2:], np.zeros(4 - n_free))
            return _length_change(self.legs_m, base, pose[:2], free) - travel_m

        found = least_squares(disagreement, np.zeros(2 + n_free), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        solution: Array = found.x[:2]
        return solution

    def turn_deg_of_travel(self, travel_m: Array) -> Array:
        """Bolt turns in deg, positive clockwise as seen by the person who turns; empty for a mount without bolts."""
        if self.pitch_m_per_turn is None:
            return np.empty(0)
        sign = 1.0 if self.turn_raises_leg == "clockwise" else -1.0
        turn: Array = rad_to_deg(sign * math.tau * np.asarray(travel_m) / self.pitch_m_per_turn)
        return turn

    def limit_violations(self, travel_m: Array) -> tuple[str, ...]:
        """One line per leg that would travel beyond the limit; legs are counted from 1. Empty when all may go."""
        return tuple(
            f"leg {k} would travel {m_to_mm(float(travel)):+.3f} mm, beyond its limit of "
            f"{m_to_mm(self.travel_limit_m):.3f} mm"
            for k, travel in enumerate(travel_m, start=1)
            if abs(travel) > self.travel_limit_m
        )

    def _leverage(self) -> Array:
        """Travel of each leg per motion of the facet at rest, shape (n_legs, n_motions), all motions in lengths.

        Motions: two tilts, then (unless a fixed point holds them) the piston of straight legs, or shifts along x, y
        and z and the turn about the normal of inclined legs.
        """
        size = _size_m(self.legs_m)
        if self.base_joints_m is None:
            tilts = -self.legs_m / size
            return tilts if self.has_fixed_point else np.column_stack([tilts, np.ones(len(tilts))])
        upper = _upper_joints(self.legs_m)
        along = upper - self.base_joints_m
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        tilts = -self.legs_m / size * along[:, 2:]
        turn = (along[:, 1] * self.legs_m[:, 0] - along[:, 0] * self.legs_m[:, 1]) / size
        return tilts if self.has_fixed_point else np.column_stack([tilts, along, turn])


def _upper_joints(legs_m: Array) -> Array:
    """Where legs meet the facet at rest, shape (n_legs, 3), facet's centre at the origin."""
    return np.column_stack([legs_m, np.zeros(len(legs_m))])


def _length_change(legs_m: Array, base_joints_m: Array, tilt_rad: Array, free: Array) -> Array:
    """Change of length of inclined legs, shape (n_legs,), for a pose: a tilt and free motions.

    `free` holds the shift along x, y, z and the turn about the normal (rad). The shifts are in units of the mount's
    size, so that a fit sees all free motions alike.
    """
    normal = np.append(tilt_rad, 1.0)
    cosine, sine = math.cos(free[3]), math.sin(free[3])
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotation = rotation_to_normal(normal / np.linalg.norm(normal)) @ turn
    upper = _upper_joints(legs_m)
    moved = upper @ rotation.T + free[:3] * _size_m(legs_m)
    change: Array = np.linalg.norm(moved - base_joints_m, axis=1) - np.linalg.norm(upper - base_joints_m, axis=1)
    return change


def _size_m(legs_m: Array) -> float:
    """Root mean square distance of the legs from the facet's centre; 1 for legs that are all in the centre."""
    return float(np.sqrt(np.mean(np.sum(legs_m**2, axis=1)))) or 1.0
