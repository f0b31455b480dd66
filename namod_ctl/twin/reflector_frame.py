"""The reflector camera's image: on each facet those points light up whose rays reach the camera's lens."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.stats import ncx2

from namod_ctl.twin.randomness import generator
from namod_ctl.twin.reflector import FacetTruth, TwinReflector
from namod_ctl.twin.sensor import Image, Sensor
from namod_ctl.twin.sky import LightTrack
from namod_ctl.twin.surface_map import FacetPixels

Array = NDArray[np.float64]

COLOUR = np.array([0.90, 1.06, 1.04], dtype=np.float32)
"""Blue, green and red of the lights and the scene, mean 1: hardly coloured."""
N_LOOKUP = 2048
N_EXACT = 200
REACH_SIGMA = 5.0
REACH_MARGIN = 1.2
"""Hits move a little more than the focal length per angle off the axis."""
TILE_MARGIN_PX = 64
STEPS_PER_APERTURE = 3.0
"""Of a moving star: a third of the lens at a time."""
N_SCENE_PX = 24
"""Size of the scene's patches of light and shade."""


class ReflectorFrames:
    """Renders exposures of the reflector camera."""

    def __init__(
        self,
        sensor: Sensor,
        reflector: TwinReflector,
        pixels: Sequence[FacetPixels],
        aperture_radius_m: float,
        seed: int,
    ) -> None:
        camera = sensor.camera
        self._sensor = sensor
        self._reflector = reflector
        self._pixels = pixels
        self._aperture_m = aperture_radius_m
        self.step_rad = aperture_radius_m / reflector.focal_length_m / STEPS_PER_APERTURE
        # Mirror area per pixel: light that reaches the lens from a facet spreads over the pixels that see it.
        per_pixel_m2 = reflector.light_m2 / np.array([max(len(p.index), 1) for p in pixels])
        area_m2 = [s.area_m2 / len(p.index) for s, p in zip(reflector.surfaces, pixels, strict=True) if len(p.index)]
        self._pixel_light = per_pixel_m2 / np.median(area_m2)
        self._hits = [np.empty((2, 0), dtype=np.float32)] * len(pixels)
        self._slopes = [np.empty((2, 2, 0), dtype=np.float32)] * len(pixels)
        self._reach_m = np.zeros(len(pixels))
        self._blur_m = reflector.blur_m
        for blur_m in self._blur_m:
            _lens_share(aperture_radius_m, float(blur_m))  # so that no exposure has to wait for it
        self._traced: FacetTruth | None = None
        self._trace(reflector.truth)
        rng = generator(seed, "scene")
        shape = (camera.n_rows // N_SCENE_PX + 2, camera.n_columns // N_SCENE_PX + 2)
        patches = cv2.resize(
            np.exp(0.5 * rng.standard_normal(shape)), (camera.n_columns, camera.n_rows), interpolation=cv2.INTER_LINEAR
        )
        self._scene = np.asarray(patches, dtype=np.float32)  # about 1, everywhere of the same colour
        self._scene_root = np.asarray(self._root(self._scene)[..., None] * self._root(COLOUR))
        noise_shape = (camera.n_rows + TILE_MARGIN_PX, camera.n_columns + TILE_MARGIN_PX, 3)
        self._noise = generator(seed, "noise of the reflector camera").standard_normal(noise_shape, dtype=np.float32)

    def _trace(self, truth: FacetTruth) -> None:
        """Trace the facets anew that do not stand as they were traced."""
        if truth is self._traced:
            return
        is_new = np.any(truth.normals != self._traced.normals, axis=1) if self._traced is not None else slice(None)
        for facet in np.arange(len(self._pixels))[is_new]:
            surface, pixels = self._reflector.surfaces[facet], self._pixels[facet]
            normal, theta = truth.normals[facet], truth.theta_rad[facet]
            if len(pixels.index):
                hits = surface.hits(pixels.across_m, normal, theta)
                slopes = surface.hit_slopes(pixels.across_m, normal, theta)
            else:
                hits, slopes = np.empty((0, 2)), np.empty((0, 2, 2))
            self._hits[facet] = np.ascontiguousarray(hits.T, dtype=np.float32)
            self._slopes[facet] = np.ascontiguousarray(slopes.transpose(1, 2, 0), dtype=np.float32)
            self._reach_m[facet] = float(np.linalg.norm(hits, axis=1).max(initial=0.0))
        self._traced = truth

    def _lit_facets(self, track: LightTrack, theta_rad: Array) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """The facets that a light reaches, and for each of their pixels the share of its light that meets the lens.

        The share is the mean over the track's steps, times its intensity. Facets that stay dark are left out.
        """
        away = track.theta_rad - theta_rad[:, None]  # facet, step, axis
        disc_m = track.diameter_rad / 4.0 * self._reflector.focal_length_m  # per axis, of a uniform disc
        edges_m = self._aperture_m + REACH_SIGMA * np.hypot(self._blur_m, disc_m)
        reach_rad = (self._reach_m + edges_m) / self._reflector.focal_length_m * REACH_MARGIN
        is_near = (np.linalg.norm(away, axis=2) < reach_rad[:, None]) & (track.intensity > 0.0)
        for facet in np.flatnonzero(is_near.any(axis=1)):
            hit, slope = self._hits[facet], self._slopes[facet]
            table, scale = _lens_share(self._aperture_m, math.hypot(self._blur_m[facet], disc_m))
            light = np.zeros(hit.shape[1], dtype=np.float32)
            steps = away[facet, is_near[facet]].astype(np.float32)
            for (dx, dy), intensity in zip(steps, track.intensity[is_near[facet]], strict=True):
                x = hit[0] + slope[0, 0] * dx + slope[0, 1] * dy
                y = hit[1] + slope[1, 0] * dx + slope[1, 1] * dy
                nearest = np.minimum((x * x + y * y) * scale, np.float32(N_LOOKUP - 1)).astype(np.intp)
                light += np.float32(intensity) * table.take(nearest)
            yield int(facet), light / np.float32(len(track.intensity))

    def render(
        self,
        tracks: Sequence[LightTrack],
        truth: FacetTruth,
        theta_moved_rad: Array,
        factor: float,
        background: tuple[float, Array],
        exposure_s: float,
        rng: np.random.Generator,
    ) -> Image:
        """The image of lights that are dimmed (or brightened) by `factor`, `background` as for `StarFrames.render`.

        `truth` is that of the facets as they stand but for sag and drift, which move them by `theta_moved_rad`
        (n_facets, 2). Facets that stand otherwise than in the last frame cost a little more.
        """
        self._trace(truth)
        sensor, camera = self._sensor, self._sensor.camera
        level, slope = background
        sky = self._sky(sensor.bright_intensity * level, sensor.bright_intensity * slope)
        mean = self._scene_root * (self._root(sky)[..., None] * np.float32(sensor.response_factor(exposure_s)))
        top, left = rng.integers(0, TILE_MARGIN_PX, 2)
        noise = self._noise[top : top + camera.n_rows, left : left + camera.n_columns]
        image = self._digitized(mean, noise)
        flat_image, scene = image.reshape(-1, 3), (self._scene * sky).reshape(-1)
        colour_root = self._root(COLOUR)
        unit = sensor.bright_intensity * factor
        shares: dict[int, NDArray[np.float32]] = {}
        for track in tracks:
            for facet, light in self._lit_facets(track, truth.theta_rad + theta_moved_rad):
                shares[facet] = shares[facet] + light if facet in shares else light
        for facet in sorted(shares):
            pixels = self._pixels[facet]
            share = shares[facet] * np.float32(unit * self._pixel_light[facet])
            is_lit = share > np.float32(1e-6 * unit)
            index = pixels.index[is_lit]
            # One colour of scene and lights: the power law is needed once per pixel.
            lit = sensor.response(scene[index] + share[is_lit], exposure_s)[:, None] * colour_root
            flat_image[index] = sensor.digitized(lit, rng.standard_normal(lit.shape, dtype=np.float32))
        return image

    def _root(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """The part of the radiometric law that turns intensities into responses; any shape."""
        root: NDArray[np.float32] = light ** np.float32(1.0 / self._sensor.law.r_resp)
        return root

    def _sky(self, level: float, slope: Array) -> NDArray[np.float32]:
        """Light of the sky on the scene, shape (rows, columns) or (1, 1) where it is the same everywhere."""
        camera = self._sensor.camera
        if not slope.any():
            return np.full((1, 1), level, dtype=np.float32)
        along = slope @ camera.orientation.image_to_telescope / camera.n_columns
        x, y = np.arange(camera.n_columns) - camera.n_columns / 2.0, np.arange(camera.n_rows) - camera.n_rows / 2.0
        sky = level + along[0] * x + along[1] * y[:, None]
        return np.asarray(np.maximum(sky, 0.0), dtype=np.float32)

    def _digitized(self, mean: NDArray[np.float32], noise: NDArray[np.float32]) -> Image:
        """Digital numbers of the whole scene, all pixels with the noise of its mean response."""
        sensor = self._sensor
        sigma = float(sensor.noise_adu(np.array(float(mean[::16, ::16].mean()))))
        if sensor.dtype == np.uint8 and sensor.camera.full_scale_adu == 255:
            summed = cv2.addWeighted(mean, 1.0, noise, sigma, sensor.settings.black_level_adu, dtype=cv2.CV_8U)
            return np.asarray(summed, dtype=np.uint8)
        adu = np.rint(mean + sigma * noise + sensor.settings.black_level_adu)
        return np.asarray(np.clip(adu, 0.0, sensor.camera.full_scale_adu), dtype=sensor.dtype)


@lru_cache(maxsize=4096)
def _lens_share(aperture_m: float, blur_m: float) -> tuple[NDArray[np.float32], np.float32]:
    """Share of light, blurred to a gaussian about its arrival, that falls into the lens.

    Returns
    -------
    The share at `N_LOOKUP` squared distances of the arrival from the lens's centre, and the entries per m^2.
    Source: a gaussian's integral over a disc off its centre is the non-central chi-square distribution with 2 degrees
    of freedom.
    """
    edge_m = aperture_m + REACH_SIGMA * blur_m
    squared_m2 = np.linspace(0.0, edge_m**2, N_LOOKUP)
    if blur_m > 0.0:  # the distribution function is slow, and smooth
        coarse_m2 = np.linspace(0.0, edge_m, N_EXACT) ** 2
        exact = ncx2.cdf((aperture_m / blur_m) ** 2, 2.0, coarse_m2 / blur_m**2)
        share = PchipInterpolator(coarse_m2, exact)(squared_m2)
    else:
        share = (squared_m2 <= aperture_m**2).astype(np.float64)
    share[-1] = 0.0
    return share.astype(np.float32), np.float32((N_LOOKUP - 1) / edge_m**2)
