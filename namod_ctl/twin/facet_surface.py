"""The true surface of one facet, and where it reflects light to: exact reflection, no small angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.coordinates import direction_to_star, rotation_to_normal
from namod_ctl.optics.raytrace import outline_area_m2, sample_outline
from namod_ctl.optics.reflector import Facet
from namod_ctl.twin.surface_map import is_inside

Array = NDArray[np.float64]

N_RAYS = 1500
"""Per facet, for moments and truth: 0.2 % of A_sigma, 0.002 arcmin of a centroid."""
STEP_RAD = 1e-5
"""Of finite differences: far above rounding, far below the curvature of any hit as a function of the star."""
N_FIGURE_ERRORS = 6
MIN_HIDDEN_SHARE = 0.015
"""Of a facet: less is the inaccuracy of its outline in the image."""


def seen_samples(facet: Facet, seen_outline_m: Array) -> Array:
    """Points that stand for equal areas of the facet, shape (n, 2), as many of `N_RAYS` as its outline shows.

    Where a mast hides a corner from the camera in the focal point, that corner's light does not get there either.
    Outlines drawn by hand differ from the facet by a little all around; that hides nothing.
    """
    samples = sample_outline(facet, N_RAYS)
    is_seen = is_inside(seen_outline_m, samples[:, 0], samples[:, 1])
    return samples[is_seen] if np.mean(is_seen) < 1.0 - MIN_HIDDEN_SHARE else samples


@dataclass(frozen=True, slots=True, eq=False)
class FacetSurface:
    """One facet as it is.

    Attributes
    ----------
    facet
        With its true focal length.
    figure_rad
        Shape (6,). Slope errors at half the facet's width: astigmatism 0/90, 45/135; coma x, y; trefoil 0, 30 deg.
    samples_m
        Shape (n, 2). Points that stand for equal areas of the part of the facet that is not hidden, facet's x and y.
    focal_plane_m
        Height of the telescope's focal plane.
    """

    facet: Facet
    figure_rad: Array
    samples_m: Array
    focal_plane_m: float

    @property
    def area_m2(self) -> float:
        """Mirror area that is not hidden."""
        return outline_area_m2(self.facet) * len(self.samples_m) / N_RAYS

    def hits(self, across_m: Array, normal: Array, theta_rad: Array) -> Array:
        """Where light of a star at `theta_rad` (2,) arrives in the focal plane, shape (n, 2), m, telescope x and y.

        `across_m` (n, 2) are points in the plane that touches the facet's centre, in the facet's own x and y;
        `normal` (3,) is the unit normal at its centre, telescope frame.
        """
        radius_m = 2.0 * self.facet.focal_length_m
        sine = across_m / radius_m
        cosine = np.sqrt(1.0 - np.sum(sine**2, axis=1))
        sag_m = radius_m * (1.0 - cosine)
        rotation = rotation_to_normal(normal)
        points = self.facet.position_m + np.column_stack([across_m, sag_m]) @ rotation.T
        local = np.column_stack([-sine / cosine[:, None] - self._figure_slopes(across_m), np.ones(len(across_m))])
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        surface_normal = local @ rotation.T
        to_star = direction_to_star(theta_rad)
        reflected = 2.0 * (surface_normal @ to_star)[:, None] * surface_normal - to_star
        way = (self.focal_plane_m - points[:, 2]) / reflected[:, 2]
        arrival: Array = points[:, :2] + reflected[:, :2] * way[:, None]
        return arrival

    def hit_slopes(self, across_m: Array, normal: Array, theta_rad: Array) -> Array:
        """d hit / d theta, shape (n, 2 of the hit, 2 of theta), m/rad."""
        columns = [
            (self.hits(across_m, normal, theta_rad + step) - self.hits(across_m, normal, theta_rad - step))
            / (2.0 * STEP_RAD)
            for step in STEP_RAD * np.eye(2)
        ]
        return np.stack(columns, axis=-1)

    def centred_theta(self, normal: Array) -> Array:
        """Star direction, shape (2,), whose light has its centroid on the focal point."""
        samples = self.samples_m
        theta = np.zeros(2)
        slopes = self.hit_slopes(samples, normal, theta).mean(axis=0)
        for _ in range(3):  # with the slopes of the first step each gains two digits or more
            theta = theta - np.linalg.solve(slopes, self.hits(samples, normal, theta).mean(axis=0))
        return theta

    def _figure_slopes(self, across_m: Array) -> Array:
        """Slope errors, shape (n, 2): gradients of r^2, r^3 cos, r^3 cos 3 and the like, 1 at half the width."""
        x, y = (across_m / (self.facet.width_m / 2.0)).T
        shapes = np.array(
            [
                [x, -y],
                [y, x],
                [(3.0 * x**2 + y**2) / 3.0, 2.0 * x * y / 3.0],
                [2.0 * x * y / 3.0, (x**2 + 3.0 * y**2) / 3.0],
                [x**2 - y**2, -2.0 * x * y],
                [2.0 * x * y, x**2 - y**2],
            ]
        )
        slopes: Array = np.einsum("k,kan->na", self.figure_rad, shapes)
        return slopes
