"""The focal plane as a camera sees it: the light of a star on a screen (or a sensor) there, with what disturbs it.

Every facet's rays arrive where its true surface sends them; its roughness spreads each into a gaussian. The image of
the screen is upright: telescope +x to the right, +y up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.raytrace import tilted_normals
from namod_ctl.optics.reflector import Reflector
from namod_ctl.twin.camera import TwinCamera
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.sensor import Image, Sensor
from namod_ctl.twin.settings import CameraSettings
from namod_ctl.twin.sky import LightTrack
from namod_ctl.twin.twin import Twin

Array = NDArray[np.float64]

ROLE = "psf"
MAX_STEPS = 16
"""Per light and exposure, of a star that moves over the screen."""
REACH_SIGMA = 6.0
"""Of the roughness' gaussian."""
MIN_STEP_PX = 0.5
"""Less than that a star may move within one step."""


PSF_CAMERA = CameraSettings(exposure_at_mag0_s=0.1, background_share=5e-3, read_noise_adu=0.8, black_level_adu=6.0)


@dataclass(frozen=True, slots=True)
class Screen:
    """What is on the screen besides the star; shares are of the brightest light of a magnitude 0 star well aligned.

    Attributes
    ----------
    camera
        The hardware of the camera that looks at it; its `background_share` is the sky's light at the middle.
    gradient_share, gradient_rad
        By how much of itself the sky's light rises from one edge of the image to the other, and towards where.
    vignetting
        Share of all light that is missing in the image's corners; it grows with the square of the distance.
    ghost_share, ghost_place, ghost_width
        Light of the star that some glass throws beside it as a wide patch: its share of the star's light, where (from
        the star, in image widths) and how wide (standard deviation, in image widths).
    """

    camera: CameraSettings = PSF_CAMERA
    gradient_share: float = 0.3
    gradient_rad: float = 1.0
    vignetting: float = 0.05
    ghost_share: float = 0.0
    ghost_place: tuple[float, float] = (0.1, 0.05)
    ghost_width: float = 0.08


class FocalScreen:
    """Renders exposures of the PSF camera.

    Parameters
    ----------
    nominal
        The reflector as the config has it, of which `reflector` is the truth.
    camera
        Its model; an angle is the distance in the focal plane over the focal length.
    """

    def __init__(
        self, nominal: Reflector, reflector: TwinReflector, camera: CameraModel, screen: Screen, seed: int
    ) -> None:
        self._nominal, self._reflector, self._camera, self._screen = nominal, reflector, camera, screen
        self.sensor = Sensor(camera, screen.camera, ROLE, seed)
        # The brightest pixel of a gaussian of area A = pi sigma^2 holds 1 / (2 A) of its light per area.
        self._peak_px = 2.0 * reflector.a_sigma_aligned_rad2() / camera.plate_scale_rad**2

    @property
    def step_rad(self) -> float:
        """A light that moves is drawn in steps of at most this."""
        return MIN_STEP_PX * self._camera.plate_scale_rad

    def light_shares(self, tracks: Sequence[LightTrack]) -> Array:
        """Light of all tracks on the screen, shape (rows, columns); a star of magnitude 0 at rest sums to 1."""
        camera, reflector = self._camera, self._reflector
        light = np.zeros((camera.n_rows, camera.n_columns))
        normals = tilted_normals(self._nominal, reflector.true_tilt_rad)
        weight = reflector.light_m2 * normals[:, 2]
        weight = weight / weight.sum()
        for facet, surface in enumerate(reflector.surfaces):
            places, shares = [], []
            for track in tracks:
                for theta, intensity in zip(track.theta_rad, track.intensity, strict=True):
                    if intensity <= 0.0:
                        continue
                    hit_m = surface.hits(surface.samples_m, normals[facet], theta)
                    places.append(camera.pixel_of_theta(hit_m / reflector.focal_length_m))
                    shares.append(np.full(len(hit_m), intensity / len(track.intensity) / len(hit_m)))
            if places:
                blur_px = reflector.blur_m[facet] / reflector.focal_length_m / camera.plate_scale_rad
                self._add(light, np.concatenate(places), weight[facet] * np.concatenate(shares), float(blur_px))
        return light

    def render(
        self,
        tracks: Sequence[LightTrack],
        factor: float,
        sky: float,
        exposure_s: float,
        rng: np.random.Generator,
    ) -> Image:
        """The image of lights dimmed by `factor`; `sky` is added to the screen's own background, in its unit."""
        sensor, camera, screen = self.sensor, self._camera, self._screen
        x = (np.arange(camera.n_columns) + 0.5) / camera.n_columns - 0.5
        y = 0.5 - (np.arange(camera.n_rows) + 0.5) / camera.n_rows  # up
        rise = screen.gradient_share * (np.cos(screen.gradient_rad) * x + np.sin(screen.gradient_rad) * y[:, None])
        light = factor * self._peak_px * self.light_shares(tracks)
        light += (screen.camera.background_share + sky) * (1.0 + rise)
        if screen.ghost_share:
            light += factor * self._ghost(tracks)
        light *= 1.0 - screen.vignetting * 2.0 * (x**2 + y[:, None] ** 2)
        mean = sensor.bloomed(sensor.response(sensor.bright_intensity * light, exposure_s))
        return sensor.digitized(mean, rng.standard_normal(mean.shape))

    def _add(self, light: Array, places: Array, shares: Array, blur_px: float) -> None:
        """Add rays that arrive at pixels `places` (n, 2), spread by `blur_px`, in place; what misses the image is lost.

        A ray counts where it arrives, so that the pixels' moments are those of the rays.
        """
        reach = int(np.ceil(REACH_SIGMA * blur_px)) + 1
        first = np.floor(places.min(axis=0) + 0.5).astype(int) - reach
        shape = (np.floor(places.max(axis=0) + 0.5).astype(int) + reach + 1 - first)[::-1]
        column, row = (np.floor(places + 0.5).astype(int) - first).T
        patch = np.bincount(row * shape[1] + column, shares, int(shape[0] * shape[1])).reshape(shape)
        patch = gaussian_filter(patch, blur_px, truncate=REACH_SIGMA, mode="constant")
        low = np.maximum(first, 0)
        high = np.minimum(first + shape[::-1], (self._camera.n_columns, self._camera.n_rows))
        if (low >= high).any():
            return
        (left, top), (right, bottom) = low - first, high - first
        light[low[1] : high[1], low[0] : high[0]] += patch[top:bottom, left:right]

    def _ghost(self, tracks: Sequence[LightTrack]) -> Array:
        camera, screen = self._camera, self._screen
        y, x = np.mgrid[: camera.n_rows, : camera.n_columns].astype(np.float64)
        width_px = screen.ghost_width * camera.n_columns
        ghost = np.zeros(x.shape)
        for track in tracks:
            # a mirror image moves against the star
            column, row = camera.pixel_of_theta(-track.theta_rad.mean(axis=0))
            column, row = column + screen.ghost_place[0] * camera.n_columns, row + screen.ghost_place[1] * camera.n_rows
            spread = np.exp(-0.5 * ((x - column) ** 2 + (y - row) ** 2) / width_px**2)
            ghost += track.intensity.mean() * screen.ghost_share * spread / (2.0 * np.pi * width_px**2)
        return self._peak_px * ghost


def focal_camera(twin: Twin, camera: CameraModel, seed: int, screen: Screen | None = None) -> TwinCamera:
    """A camera of the twin that looks at its focal plane: a `core.interfaces.Camera` on the twin's clock."""
    screen = Screen() if screen is None else screen
    focal = FocalScreen(twin.instrument.reflector, twin.reflector, camera, screen, seed)

    def render(start_s: float, exposure_s: float, rng: np.random.Generator) -> Image:
        tracks = twin.sky.tracks(start_s, start_s + exposure_s, focal.step_rad, MAX_STEPS)
        dish_m = float(np.sqrt(twin.reflector.light_m2.sum()))
        factor = twin.sky.scintillation(start_s, exposure_s, dish_m, rng)
        level, _ = twin.sky.background(start_s + exposure_s / 2.0)
        return focal.render(tracks, factor, level, exposure_s, rng)

    return TwinCamera(ROLE, focal.sensor, twin.clock, twin.update, render, FaultPlan(), seed)
