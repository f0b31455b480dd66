"""The star camera's image: stars as points of light through its lens, integrated over pixels and the exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Image, Sensor
from namod_ctl.twin.sky import LightTrack

Array = NDArray[np.float64]

LENS_BLUR = ((0.9, 1.0), (0.1, 2.0))
"""Share of light and width, relative to the star's size, of the core and the halo that the lens makes of a point."""
FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
REACH_SIGMA = 5.0
TILE_MARGIN_PX = 256
BLOCK_PX = 64
STEPS_PER_SIGMA = 2.0
"""Of a moving star."""


class StarFrames:
    """Renders exposures of the star camera."""

    def __init__(self, sensor: Sensor, star_size_rad: float, seed: int) -> None:
        camera = sensor.camera
        self._sensor = sensor
        self._sigma_px = star_size_rad / camera.plate_scale_rad / FWHM_PER_SIGMA
        self.step_rad = self._sigma_px / STEPS_PER_SIGMA * camera.plate_scale_rad
        # The brightest pixel of a star in a pixel's middle holds this share of its light.
        self._peak_share = self._profile(np.zeros(1), 0.0)[0, 0] if self._sigma_px > 0 else 1.0
        shape = (camera.n_rows + TILE_MARGIN_PX, camera.n_columns + TILE_MARGIN_PX)
        noise = generator(seed, "noise of the star camera").bytes(shape[0] * shape[1])
        self._noise = np.frombuffer(noise, dtype=np.uint8).reshape(shape)

    def render(
        self,
        tracks: Sequence[LightTrack],
        factor: float,
        background: tuple[float, Array],
        exposure_s: float,
        rng: np.random.Generator,
    ) -> Image:
        """The image of lights that are dimmed (or brightened) by `factor` on their way.

        `background` is the sky's level and slope over the image, in the star camera's unit: a magnitude 0 star's
        brightest pixel.
        """
        sensor, camera = self._sensor, self._sensor.camera
        level, slope = background
        sky = sensor.bright_intensity * level
        image = self._sky(sky, sensor.bright_intensity * slope, exposure_s, rng)
        light, touched = self._light(tracks, factor)
        slope_px = self._slope_per_pixel(sensor.bright_intensity * slope)
        for rows, columns in touched:
            y, x = np.mgrid[rows, columns]
            below = sky + slope_px[0] * (x - camera.n_columns / 2.0) + slope_px[1] * (y - camera.n_rows / 2.0)
            mean = sensor.bloomed(sensor.response(light[rows, columns] + below, exposure_s))
            image[rows, columns] = sensor.digitized(mean, rng.standard_normal(mean.shape))
        return image

    def _slope_per_pixel(self, slope: Array) -> Array:
        """Slope of the sky along columns and rows, per pixel, of one across the image along telescope x and y."""
        camera = self._sensor.camera
        per_pixel: Array = slope @ camera.orientation.image_to_telescope / camera.n_columns
        return per_pixel

    def _sky(self, level: float, slope: Array, exposure_s: float, rng: np.random.Generator) -> Image:
        sensor, camera = self._sensor, self._sensor.camera
        top, left = rng.integers(0, TILE_MARGIN_PX, 2)
        noise = self._noise[top : top + camera.n_rows, left : left + camera.n_columns]
        if not slope.any():
            mean_adu = sensor.response(np.array([level]), exposure_s)
            return _looked_up(noise, sensor.quantile_tables(mean_adu)[0])
        slope_px = self._slope_per_pixel(slope)
        # A sky changes slowly: within a block its mean response is the same.
        tops, lefts = np.arange(0, camera.n_rows, BLOCK_PX), np.arange(0, camera.n_columns, BLOCK_PX)
        x = lefts + (BLOCK_PX - camera.n_columns) / 2.0
        y = tops[:, None] + (BLOCK_PX - camera.n_rows) / 2.0
        mean_adu = sensor.response(level + slope_px[0] * x + slope_px[1] * y, exposure_s)
        tables = sensor.quantile_tables(mean_adu.ravel()).reshape(*mean_adu.shape, -1)
        image = np.empty((camera.n_rows, camera.n_columns), dtype=sensor.dtype)
        for i, j in np.ndindex(mean_adu.shape):
            block = (slice(tops[i], tops[i] + BLOCK_PX), slice(lefts[j], lefts[j] + BLOCK_PX))
            image[block] = _looked_up(noise[block], tables[i, j])
        return image

    def _light(self, tracks: Sequence[LightTrack], factor: float) -> tuple[Array, list[tuple[slice, slice]]]:
        """Intensity of all lights, and the blocks of the image that they touch (with room for blooming)."""
        camera = self._sensor.camera
        light = np.zeros((camera.n_rows, camera.n_columns))
        is_touched = np.zeros((-(-camera.n_rows // BLOCK_PX), -(-camera.n_columns // BLOCK_PX)), dtype=bool)
        unit = self._sensor.bright_intensity / self._peak_share * factor
        for track in tracks:
            disc_px = track.diameter_rad / camera.plate_scale_rad
            reach = math.ceil(REACH_SIGMA * max(width for _, width in LENS_BLUR) * self._sigma_px + disc_px)
            for (x, y), intensity in zip(camera.pixel_of_theta(track.theta_rad), track.intensity, strict=True):
                first, last = np.floor((x, y)) - reach, np.ceil((x, y)) + reach + 1
                (left, top), (right, bottom) = (
                    np.clip(corner, 0, (camera.n_columns, camera.n_rows)).astype(int) for corner in (first, last)
                )
                if left >= right or top >= bottom or intensity <= 0.0:
                    continue
                stamp = self._stamp(np.arange(left, right) - x, np.arange(top, bottom) - y, disc_px)
                light[top:bottom, left:right] += unit * intensity / len(track.intensity) * stamp
                is_touched[
                    top // BLOCK_PX : (bottom - 1) // BLOCK_PX + 1, left // BLOCK_PX : (right - 1) // BLOCK_PX + 1
                ] = True
        return light, _columns_of(is_touched, light.shape)

    def _stamp(self, x: Array, y: Array, disc_px: float) -> Array:
        """Share of a point's light in each pixel, shape (rows, columns), at these distances from it."""
        stamp = np.zeros((len(y), len(x)))
        for share, width in LENS_BLUR:
            # A uniform disc of diameter d has the variance d^2 / 16 along each axis.
            sigma = math.hypot(width * self._sigma_px, disc_px / 4.0)
            stamp += share * np.outer(_in_pixels(y, sigma), _in_pixels(x, sigma))
        return stamp

    def _profile(self, offsets: Array, disc_px: float) -> Array:
        return self._stamp(offsets, offsets, disc_px)


def _looked_up(noise: NDArray[np.uint8], table: Image) -> Image:
    """The table's entries; OpenCV's look-up is several times as fast, and surely knows 8 bit."""
    if table.dtype == np.uint8:
        return np.asarray(cv2.LUT(noise, table), dtype=np.uint8)
    return table[noise]


def _in_pixels(offset: Array, sigma: float) -> Array:
    """Integral of a normalized gaussian over pixels at these offsets."""
    edges = np.append(offset - 0.5, offset[-1] + 0.5) / (math.sqrt(2.0) * sigma)
    share: Array = 0.5 * np.diff(erf(edges))
    return share


def _columns_of(is_touched: NDArray[np.bool_], shape: tuple[int, int]) -> list[tuple[slice, slice]]:
    """The touched blocks, those on top of each other as one with a block above and below: charge spills there."""
    pieces = []
    for j in np.flatnonzero(is_touched.any(axis=0)):
        rows = np.flatnonzero(is_touched[:, j])
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 2) + 1):
            top, bottom = max(int(run[0]) - 1, 0) * BLOCK_PX, (int(run[-1]) + 2) * BLOCK_PX
            left, right = int(j) * BLOCK_PX, int(j + 1) * BLOCK_PX
            pieces.append((slice(top, min(bottom, shape[0])), slice(left, min(right, shape[1]))))
    return pieces
