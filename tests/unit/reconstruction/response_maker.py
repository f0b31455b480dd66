"""Response tables of known content: facets with figure errors throw rays, a small camera counts them.

Geometry only, and none of the package's: a ray of a facet that leaves towards `centre + slope error` reaches the camera
when the star stands within the camera's aperture of that direction. The truth of a facet is the mean of its rays.
Angles in radians throughout; the numbers behind the defaults are in degrees because the telescope's were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.reconstruction.responses import ResponseTable

DEG = np.pi / 180.0
ARCMIN = DEG / 60.0

FIGURE_RAD = DEG * np.array([0.012, 0.012, 0.012, 0.006, 0.006, 0.006])
"""Spread of defocus, two astigmatisms, two comas and trefoil as image blur: widths of 1 to 2 arcmin, as FACT's."""
ROUGHNESS_RAD = 0.009 * DEG
APERTURE_RAD = 0.02 * DEG  # radius of FACT's camera lens seen from the dish, 1.7 mm over 4.889 m
N_RAYS = 3000  # their counting noise, 3 % of a typical response, is below the noise of the records


@dataclass(frozen=True)
class MadeRun:
    """A table and what it was made from.

    `centre_rad` (n_facets, 2), `cov_rad2` (n_facets, 2, 2) and `flux` (n_facets,) are the moments of each facet's light
    over star directions, `light` (n_records, n_facets) the responses without noise and background.
    """

    table: ResponseTable
    centre_rad: np.ndarray
    cov_rad2: np.ndarray
    flux: np.ndarray
    light: np.ndarray

    @property
    def a_sigma_rad2(self):
        """A_sigma of all facets' light together."""
        share = self.flux / self.flux.sum()
        offset = self.centre_rad - share @ self.centre_rad
        cov = np.einsum("j,jab->ab", share, self.cov_rad2) + np.einsum("j,ja,jb->ab", share, offset, offset)
        return np.pi * np.sqrt(np.linalg.det(cov))

    def with_response(self, response):
        """The same run with other responses."""
        return replace(self, table=replace(self.table, response=response))

    def with_theta(self, theta_rad):
        """The same run with other recorded directions."""
        return replace(self, table=replace(self.table, theta_rad=theta_rad))

    def select(self, keep):
        """The same run with some of its records only."""
        return replace(self, table=self.table.select(keep), light=self.light[keep])


def disc(rng, n, radius_rad=0.35 * DEG):
    """Directions (n, 2) evenly spread over a disc."""
    radius, angle = radius_rad * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def graded_disc(rng, n, contrast=10.0, radius_rad=0.35 * DEG):
    """Directions (n, 2) over a disc whose density grows `contrast`-fold from the left rim to the right one."""
    theta = disc(rng, int(2 * contrast) * n, radius_rad)
    keep = rng.random(len(theta)) < contrast ** (0.5 * theta[:, 0] / radius_rad - 0.5)
    return theta[keep][:n]


def wandering_path(rng, n, radius_rad=0.35 * DEG):
    """Directions (n, 2) along a noisy spiral, as of a telescope steered by hand: dense inside, sparse outside."""
    t = np.linspace(0.05, 1.0, n)
    angle = 30.0 * t + 0.3 * np.cumsum(rng.normal(0, 0.1, n))
    radius = radius_rad * t
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1) + rng.normal(0, 0.02 * DEG, (n, 2))


def facet_rays(rng, figure=1.0, n_rays=N_RAYS):
    """Directions (n_rays, 2) of a facet's rays about their mean: low-order figure errors and roughness."""
    x, y = _hexagon(rng, n_rays)
    defocus, astig, astig_45, coma_x, coma_y, trefoil = rng.normal(size=6) * FIGURE_RAD * figure
    slope_x = (
        2 * defocus * x
        + 2 * astig * x
        + 2 * astig_45 * y
        + coma_x * (3 * x**2 + y**2)
        + 2 * coma_y * x * y
        + 3 * trefoil * (x**2 - y**2)
    )
    slope_y = (
        2 * defocus * y
        - 2 * astig * y
        + 2 * astig_45 * x
        + 2 * coma_x * x * y
        + coma_y * (3 * y**2 + x**2)
        - 6 * trefoil * x * y
    )
    rays = np.stack([slope_x, slope_y], axis=1) + rng.normal(0, ROUGHNESS_RAD, (n_rays, 2))
    return rays - rays.mean(axis=0)


def _hexagon(rng, n):
    """Points in a hexagon of width 2 across its corners, coordinates of shape (2, n)."""
    points = rng.uniform(-1, 1, (3 * n, 2))
    x, y = np.abs(points).T
    inside = points[(y < np.sqrt(0.75)) & (x < 1 - y / np.sqrt(3))]
    return inside[:n].T


def make_run(
    seed,
    n_records=1350,
    n_facets=30,
    path=disc,
    misalignment_rad=4 * ARCMIN,
    noise=0.04,
    dark=3e-4,
    figure=1.0,
    centres_rad=None,
):
    """A run of `n_records` along `path(rng, n_records)`.

    `noise` is the relative scatter of a response, `dark` the one of an unlit facet (of a lit facet's response of about
    1); centres are drawn with a spread of `misalignment_rad` per axis unless given.
    """
    rng = np.random.default_rng(seed)
    theta = path(rng, n_records)
    n_records = len(theta)
    centre = rng.normal(0, misalignment_rad, (n_facets, 2)) if centres_rad is None else np.asarray(centres_rad)
    light, cov = np.empty((n_records, len(centre))), np.empty((len(centre), 2, 2))
    flux = rng.uniform(0.6, 1.2, len(centre))
    for j in range(len(centre)):
        rays = facet_rays(rng, figure)
        hits = cKDTree(rays + centre[j]).query_ball_point(theta, APERTURE_RAD, return_length=True)
        light[:, j] = flux[j] * hits / len(rays)
        cov[j] = np.cov(rays.T) + APERTURE_RAD**2 / 4 * np.eye(
            2
        )  # a disc's variance per axis is a quarter of its radius^2
    response = light * np.exp(noise * rng.normal(size=light.shape)) + dark * np.abs(rng.normal(1, 0.3, light.shape))
    ids = tuple(range(1, len(centre) + 1))
    table = ResponseTable(
        ids, np.arange(1, n_records + 1), theta, np.full(n_records, np.nan), response, np.ones(n_records)
    )
    return MadeRun(table, centre, cov, flux, light)


def instrument(n_facets=30):
    """A telescope of so many facets on tripods that aims at the star camera's calibrated axis."""
    n = int(np.ceil(np.sqrt(n_facets)))
    x, y = np.array([(i % n - (n - 1) / 2, i // n - (n - 1) / 2) for i in range(n_facets)]).T * 0.62
    focal_length_m = 4.889
    z = focal_length_m - np.sqrt(focal_length_m**2 - x**2 - y**2)  # Davies-Cotton
    facets = tuple(
        Facet(i + 1, np.array([x[i], y[i], z[i]]), focal_length_m, FacetShape.HEXAGON, 0.606) for i in range(n_facets)
    )
    angle = 2 * np.pi / 3 * np.arange(3)
    tripod = Mount(0.295 * np.stack([np.cos(angle), np.sin(angle)], axis=1), False, 0.05, pitch_m_per_turn=1e-3)
    law = RadiometricLaw(1.0, -1.0, 0.0)
    camera = CameraModel("camera", 640, 480, 4e-5, np.array([319.5, 239.5]), True, CameraOrientation(), law)
    reflector = Reflector(focal_length_m, facets)
    return Instrument(
        "test dish", reflector, dict.fromkeys(reflector.ids, tripod), camera, camera, {}, 5 * DEG, 0.025 * DEG
    )
