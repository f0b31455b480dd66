"""Plate scale from one long exposure in which a star draws a streak: its length is the exposure times the sky's rate.

Less precise than many short exposures: it rests on the two ends of the streak and on the shutter alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.special import erf

from namod_ctl.calibration.geometry.star_trail import MAX_SCALE_CHANGE
from namod_ctl.calibration.geometry.trail_solution import K1_SIGMA, KNOWN_K1_SIGMA
from namod_ctl.calibration.sky.star_path import EARTH_RATE_RAD_PER_S, REFRACTION_SHRINKS, REFRACTION_UNCERTAINTY
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import rad_to_mdeg
from namod_ctl.imaging.measure import without_dark
from namod_ctl.imaging.radiometry import Frame, grey_frame, response_table, saturation_adu
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

MIN_STREAK_PX = 40.0
MIN_SIGMAS = 6.0
BAND_STARS = 2.0
"""Half width of the band along the streak whose light counts, in diameters of a star."""
RIVAL_SHARE = 0.3
MAX_SATURATED_SHARE = 0.01
SHUTTER_UNCERTAINTY_S = 0.01
LAW_UNCERTAINTY_STARS = 0.015
"""Length of the streak, in diameters of a star, by which a radiometric law with r_resp wrong by 0.02 errs."""
FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))


@dataclass(frozen=True, slots=True, eq=False)
class StreakFit:
    """A streak and what it says.

    Attributes
    ----------
    ends_px
        Shape (2, 2): (x, y) of both ends; nobody knows which one was first.
    direction_rad
        Of the streak, from the image's columns counter-clockwise, in (-pi/2, pi/2].
    residual_rms_px
        Of the profile along the streak, as a shift of its ends.
    """

    plate_scale_rad: float
    plate_scale_uncertainty_rad: float
    ends_px: Array
    ends_uncertainty_px: Array
    direction_rad: float
    residual_rms_px: float


def fit_streak(
    frame: Frame, camera: CameraModel, star_size_rad: float, exposure_s: float, declination_rad: float
) -> StreakFit:
    """Plate scale from the streak of a star of that declination (of date) in one frame.

    Raises
    ------
    DataQualityError
        No streak, more than one, one that leaves the frame, or one that clouds have cut.
    """
    saturated_adu = saturation_adu(camera)
    grey = grey_frame(without_dark(frame, camera, exposure_s), saturated_adu)
    signal = response_table(camera, grey.dtype).take(grey)  # of light: a bent response would lengthen the streak
    signal = (signal - np.median(signal)) / signal.max()
    size_px = star_size_rad / camera.plate_scale_rad
    centre, along, is_streak = _line(signal, size_px)
    saturated_share = float(np.mean(grey[is_streak] >= saturated_adu))
    if saturated_share > MAX_SATURATED_SHARE:
        raise DataQualityError(
            f"{saturated_share:.0%} of the streak is saturated: close the lens' aperture, or take a fainter star"
        )
    if _touches_edge(is_streak, size_px):
        raise DataQualityError("the streak leaves the frame: point so that it begins and ends inside, and record anew")
    place, profile, noise = _profile(signal, centre, along, size_px)
    values, covariance, rms = _box_of(place, profile, noise, size_px)
    first, last = values[0], values[1]
    straight = camera.distortion.straightened if camera.distortion is not None else None
    ends = centre[:2] + np.outer([first, last], along)
    ends_straight = ends if straight is None else straight(ends, camera.plate_scale_rad)
    length_px = float(np.linalg.norm(ends_straight[1] - ends_straight[0]))
    way_rad = EARTH_RATE_RAD_PER_S * exposure_s * (1.0 - REFRACTION_SHRINKS)
    chord_rad = 2.0 * math.asin(math.cos(declination_rad) * math.sin(way_rad / 2.0))
    scale_rad = chord_rad / length_px
    if not 1.0 - MAX_SCALE_CHANGE < scale_rad / camera.plate_scale_rad < 1.0 + MAX_SCALE_CHANGE:
        raise DataQualityError(
            f"the streak of {length_px:.0f} pixel would mean {rad_to_mdeg(scale_rad):.3f} mdeg per pixel, the config "
            f"says {rad_to_mdeg(camera.plate_scale_rad):.3f}: the drive moved, it is another star, or the exposure of "
            f"{exposure_s:g} s is wrong"
        )
    step = np.array([-1.0, 1.0])
    middle = np.array([camera.n_columns - 1, camera.n_rows - 1]) / 2.0
    reach_rad = scale_rad * float(np.linalg.norm(ends - middle, axis=1).max())
    k1_sigma = K1_SIGMA if camera.distortion is None else KNOWN_K1_SIGMA
    relative = math.hypot(
        math.sqrt(float(step @ covariance[:2, :2] @ step)) / length_px,
        REFRACTION_UNCERTAINTY,
        SHUTTER_UNCERTAINTY_S / exposure_s,
        LAW_UNCERTAINTY_STARS * size_px / length_px,
        k1_sigma * reach_rad**2,
    )
    return StreakFit(
        plate_scale_rad=scale_rad,
        plate_scale_uncertainty_rad=scale_rad * relative,
        ends_px=ends,
        ends_uncertainty_px=np.sqrt(np.diag(covariance)[:2]),
        direction_rad=math.atan(-along[1] / along[0]) if along[0] else math.pi / 2.0,
        residual_rms_px=rms,
    )


def _line(signal: Array, size_px: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """A point (2,) on the only streak, its direction (2,), and where (rows, columns) it is."""
    smooth = cv2.GaussianBlur(signal, (0, 0), max(size_px / FWHM_PER_SIGMA, 1.0))
    noise = 1.4826 * float(np.median(np.abs(smooth - np.median(smooth))))
    is_bright = (smooth > max(MIN_SIGMAS * noise, 0.2 * float(smooth.max()))).astype(np.uint8)
    n_pieces, labels, statistics, _ = cv2.connectedComponentsWithStats(is_bright)
    spans = np.hypot(statistics[1:, cv2.CC_STAT_WIDTH], statistics[1:, cv2.CC_STAT_HEIGHT])
    if n_pieces < 2 or spans.max() < MIN_STREAK_PX:
        longest = float(spans.max()) if n_pieces > 1 else 0.0
        raise DataQualityError(
            f"no streak of at least {MIN_STREAK_PX:.0f} pixel in the frame (longest light: {longest:.0f}): expose for "
            "longer with the drive stopped, or give many short exposures"
        )
    longest = int(spans.argmax())
    others = np.delete(spans, longest)
    if len(others) and others.max() > RIVAL_SHARE * spans[longest]:
        raise DataQualityError(
            f"{int(np.count_nonzero(others > RIVAL_SHARE * spans[longest])) + 1} streaks in the frame: several stars, "
            "or clouds that cut one; choose a star that stands alone in a clear sky"
        )
    is_streak = labels == longest + 1
    rows, columns = np.nonzero(is_streak)
    weight = np.maximum(signal[rows, columns], 0.0)
    points = np.column_stack([columns, rows]).astype(np.float64)
    centre = np.average(points, axis=0, weights=weight)
    offset = points - centre
    direction = np.linalg.eigh((offset.T * weight) @ offset)[1][:, 1]
    return centre, direction if direction[0] >= 0.0 else -direction, is_streak


def _touches_edge(is_streak: NDArray[np.bool_], size_px: float) -> bool:
    """The streak comes closer to the frame's edge than a star is wide: part of it may be outside."""
    rows, columns = np.nonzero(is_streak)
    n_rows, n_columns = is_streak.shape
    room_px = min(rows.min(), columns.min(), n_rows - 1 - rows.max(), n_columns - 1 - columns.max())
    return bool(room_px < size_px)


def _profile(signal: Array, centre: Array, along: Array, size_px: float) -> tuple[Array, Array, float]:
    """Place along the streak (n,), the light there, and the noise of that."""
    across = np.array([-along[1], along[0]])
    reach = int(np.hypot(*signal.shape))
    place = np.arange(-reach, reach + 1, dtype=np.float64)
    band = np.arange(-math.ceil(BAND_STARS * size_px), math.ceil(BAND_STARS * size_px) + 1, dtype=np.float64)
    grid = centre + place[:, None, None] * along + band[None, :, None] * across
    is_inside = np.all((grid >= 0.0) & (grid <= np.array([signal.shape[1], signal.shape[0]]) - 1.0), axis=(1, 2))
    grid, place = grid[is_inside].astype(np.float32), place[is_inside]
    light = cv2.remap(signal.astype(np.float32), grid[..., 0], grid[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    profile = light.sum(axis=1)
    steps = np.diff(profile)
    noise = float(1.4826 * np.median(np.abs(steps - np.median(steps))) / math.sqrt(2.0))
    return place, profile, max(noise, 1e-6)


def _box_of(place: Array, profile: Array, noise: float, size_px: float) -> tuple[Array, Array, float]:
    """Begin, end, blur, height, slope and background of a blurred box; their covariance; misfit as a shift in pixel."""

    def box(x: Array, first: float, last: float, blur: float, height: float, slope: float, sky: float) -> Array:
        lit = 0.5 * (erf((x - first) / (math.sqrt(2.0) * blur)) - erf((x - last) / (math.sqrt(2.0) * blur)))
        value: Array = sky + (height + slope * (x - 0.5 * (first + last))) * lit
        return value

    bright = place[profile > 0.5 * np.percentile(profile, 99.0)]
    start = (bright[0], bright[-1], size_px / FWHM_PER_SIGMA, float(np.percentile(profile, 90.0)), 0.0, 0.0)
    try:
        values, covariance = curve_fit(
            box, place, profile, p0=start, sigma=np.full(len(place), noise), absolute_sigma=True
        )
    except RuntimeError:
        raise DataQualityError("the light along the streak is not that of a star: clouds cut it; record anew") from None
    left = profile - box(place, *values)
    is_lit = (place > values[0]) & (place < values[1])
    unevenness = float(np.std(left[is_lit])) / abs(float(values[3])) if is_lit.any() else 1.0
    if unevenness > 0.3:
        raise DataQualityError(
            f"the streak's light varies by {unevenness:.0%} along it: clouds; record anew in a clear sky"
        )
    chi2 = float(np.mean((left / noise) ** 2))
    edge_slope = abs(float(values[3])) / (math.sqrt(math.tau) * abs(float(values[2])))
    return values, covariance * max(chi2, 1.0), float(np.std(left)) / edge_slope
