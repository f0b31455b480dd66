"""Facets whose legs move, and what is seen of it: planes through the ends of legs, backlash, noise. Not the program's.

The true change of a facet's normal follows from where the ends of its legs are afterwards (three points make a plane);
only a hexapod's pose is taken from the mount's own kinematics, which its tests hold against scipy's rotations.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from namod_ctl.cycle.evidence import Observation
from namod_ctl.optics.mounts import Mount

ARCMIN = np.pi / 180.0 / 60.0
UM = 1e-6


def on_circle(radius_m: float, *azimuth_deg: float) -> np.ndarray:
    azimuth = np.radians(azimuth_deg)
    return radius_m * np.column_stack([np.cos(azimuth), np.sin(azimuth)])


FACT_TRIPOD = Mount(on_circle(0.295, 0, 120, 240), False, 0.01, backlash_m=10 * UM, pitch_m_per_turn=0.001)
TWO_ACTUATORS = Mount(np.array([[0.3, 0.0], [0.0, 0.3]]), True, 0.01, backlash_m=10 * UM)
HEXAPOD = Mount(
    on_circle(0.3, -10, 10, 110, 130, 230, 250),
    False,
    0.03,
    backlash_m=10 * UM,
    base_joints_m=np.column_stack([on_circle(0.4, -50, 50, 70, 170, 190, 290), np.full(6, -0.3)]),
)
MOUNTS = {"tripod": FACT_TRIPOD, "two actuators": TWO_ACTUATORS, "hexapod": HEXAPOD}


def tilt_by_geometry(mount: Mount, travel_m: np.ndarray) -> np.ndarray:
    """Change of the normal of a facet that was level: from the plane through three points."""
    if mount.base_joints_m is not None:
        return mount.tilt_of_travel(travel_m)
    ends = np.column_stack([mount.legs_m, travel_m])
    if mount.has_fixed_point:
        ends = np.vstack([ends, np.zeros(3)])
    normal = np.cross(ends[1] - ends[0], ends[2] - ends[0])
    return normal[:2] / normal[2]


class Dish:
    """True directions of facets, their legs with backlash, and a camera that sees them with noise.

    Attributes
    ----------
    wiring
        Per (facet, leg): the (facet, leg) whose orders it follows, and its gain. Missing: its own, 1.
    """

    def __init__(self, mount: Mount, n_facets: int, noise_arcmin: float, rng: np.random.Generator) -> None:
        self.rng, self.mount, self.ids = rng, mount, list(range(1, n_facets + 1))
        self.mounts: Mapping[int, Mount] = dict.fromkeys(self.ids, mount)
        self.theta = {j: rng.normal(0.0, 4.0 * ARCMIN, 2) for j in self.ids}
        self.n_legs = len(mount.legs_m)
        self.last_sense = {j: rng.choice([-1.0, 1.0], self.n_legs) for j in self.ids}
        self.noise_arcmin = noise_arcmin
        self.wiring: dict[tuple[int, int], tuple[int, int, float]] = {}
        self.axis = np.zeros(2)
        self.seen = self.look()

    def look(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Estimates; each facet's covariance is its own, and oblique."""
        seen = {}
        for j in self.ids:
            turn = on_circle(1.0, *(self.rng.uniform(0, 360) + np.array([0.0, 90.0])))
            sigma = self.noise_arcmin * ARCMIN * np.array([1.0, self.rng.uniform(0.5, 1.0)])
            cov = turn.T @ np.diag(sigma**2) @ turn
            seen[j] = (self.rng.multivariate_normal(self.theta[j] + self.axis, cov, method="cholesky"), cov)
        return seen

    def orders(self) -> dict[int, np.ndarray]:
        """Travels that would bring what is seen to (0, 0)."""
        return {j: self.mount.travel_of_tilt(-theta / 2.0) for j, (theta, _) in self.seen.items()}

    def move(self, orders: Mapping[int, np.ndarray], extra: Mapping[int, np.ndarray] | None = None) -> Observation:
        """Carry the orders out by the wiring, with lost travel; `extra` tilts facets besides (rad of Theta)."""
        before = self.seen
        for j in self.ids:
            made = np.zeros(self.n_legs)
            for k in range(self.n_legs):
                source, leg, gain = self.wiring.get((j, k), (j, k, 1.0))
                made[k] = gain * orders[source][leg] if source in orders else 0.0
                sense = np.sign(made[k])
                if sense * self.last_sense[j][k] < 0.0:
                    made[k] -= sense * min(abs(made[k]), self.mount.backlash_m)
                if sense:
                    self.last_sense[j][k] = sense
            self.theta[j] = self.theta[j] + 2.0 * tilt_by_geometry(self.mount, made)
            if extra and j in extra:
                self.theta[j] = self.theta[j] + extra[j]
        self.axis = self.axis + self.rng.normal(0.0, 0.3 * ARCMIN, 2)
        self.seen = self.look()
        return Observation(orders, before, self.seen)
