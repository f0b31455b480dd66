"""The telescope's drives: where the reference star stands in the telescope frame, a function of time alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import TelescopeSettings

Array = NDArray[np.float64]

N_JITTER_TONES = 8
JITTER_HZ = (0.05, 3.0)
NEW_TURN_RAD = math.tau * (math.sqrt(5.0) - 1.0) / 2.0
"""Golden angle: no two passes lie on each other."""
WAYPOINT_RADII = 0.9
"""Mean distance between two random points of a disc, in its radii (128 / 45 pi = 0.905)."""


class Telescope:
    """Wanders around the star on its own; nobody can ask it where it is."""

    def __init__(self, settings: TelescopeSettings, faults: FaultPlan, seed: int) -> None:
        self._settings = settings
        self._faults = faults
        self._seed = seed
        rng = generator(seed, "jitter")
        self._tone_hz = np.exp(rng.uniform(math.log(JITTER_HZ[0]), math.log(JITTER_HZ[1]), (2, N_JITTER_TONES)))
        self._tone_phase = rng.uniform(0.0, math.tau, (2, N_JITTER_TONES))
        self._turn_rad = float(generator(seed, "turn").uniform(0.0, math.tau))
        self._waypoints: dict[int, Array] = {}

    @property
    def pass_s(self) -> float:
        """How long the telescope takes to cover its region once."""
        s = self._settings
        return math.pi * s.radius_rad**2 / (s.spacing_rad * s.speed_rad_per_s)

    def star_theta(self, times_s: Array) -> Array:
        """Direction of the reference star, shape (n, 2), rad, telescope frame, at `times_s` (n,)."""
        s = self._settings
        match s.pattern:
            case "spiral":
                path = self._spiral(times_s)
            case "raster":
                path = self._raster(times_s)
            case "random":
                path = self._random(times_s)
        phase = math.tau * self._tone_hz[:, None, :] * times_s[:, None] + self._tone_phase[:, None, :]
        jitter = s.jitter_rad * math.sqrt(2.0 / N_JITTER_TONES) * np.sin(phase).sum(axis=-1).T
        theta: Array = np.array(s.centre_rad) + path + jitter
        for fault in self._faults.of("telescope_jump"):
            is_active = (times_s >= fault.start_s) & (times_s < fault.end_s)
            theta[is_active] += (fault.value("x_rad"), fault.value("y_rad"))
        return theta

    def _spiral(self, times_s: Array) -> Array:
        """Spiral of equal density, out and in again between its own turns; turned anew when it leaves the centre."""
        s = self._settings
        number, share = np.divmod(times_s / self.pass_s, 1.0)
        is_inward = number % 2 == 1
        radius = s.radius_rad * np.sqrt(np.where(is_inward, 1.0 - share, share))
        wound = np.where(is_inward, 2.0 * s.radius_rad - radius, radius) / s.spacing_rad
        angle = self._turn_rad + math.tau * wound + NEW_TURN_RAD * np.floor(number / 2.0)
        path: Array = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return path

    def _raster(self, times_s: Array) -> Array:
        """Lines over the square around the region, to and fro, up and down; rounded turns."""
        s = self._settings
        n_lines = max(math.ceil(2.0 * s.radius_rad / s.spacing_rad), 1)
        line_s = 2.0 * s.radius_rad / s.speed_rad_per_s
        along = times_s / line_s % 2.0
        across = times_s / (line_s * n_lines) % 2.0
        x, y = (2.0 * np.where(p < 1.0, p, 2.0 - p) - 1.0 for p in (along, across))
        turned = np.column_stack([x, y]) * s.radius_rad
        cosine, sine = math.cos(self._turn_rad), math.sin(self._turn_rad)
        path: Array = turned @ np.array([[cosine, sine], [-sine, cosine]])
        return path

    def _random(self, times_s: Array) -> Array:
        """Smooth way (Catmull-Rom) through random points of the region."""
        s = self._settings
        leg, share = np.divmod(times_s * s.speed_rad_per_s / (WAYPOINT_RADII * s.radius_rad), 1.0)
        points = np.array([[self._waypoint(int(k) + i) for i in range(4)] for k in leg])
        before, start, end, after = (points[:, i] for i in range(4))
        t = share[:, None]
        path: Array = start + 0.5 * t * (
            end
            - before
            + t * (2.0 * before - 5.0 * start + 4.0 * end - after + t * (3.0 * (start - end) + after - before))
        )
        return path

    def _waypoint(self, number: int) -> Array:
        if number not in self._waypoints:
            radius, angle = generator(self._seed, "waypoint", number).random(2) * (1.0, math.tau)
            radius = self._settings.radius_rad * math.sqrt(radius)
            self._waypoints[number] = radius * np.array([math.cos(angle), math.sin(angle)])
        return self._waypoints[number]
