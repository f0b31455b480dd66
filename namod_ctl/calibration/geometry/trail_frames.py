"""From a series of frames to the trail of one star: what shines in every frame, and which of it moves steadily.

Every spot of a frame that could be a star is measured. Then one path is looked for that most spots lie on: hot pixels
and lamps stand still, satellites are too fast for more than a few frames, clouds take spots away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.geometry.star_trail import MIN_LENGTH_PX
from namod_ctl.calibration.geometry.trail_solution import MIN_POINTS, Trail
from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.measure import without_dark
from namod_ctl.imaging.radiometry import Frame, grey_frame, response_table, saturation_adu
from namod_ctl.imaging.star import MIN_DIAMETER, MIN_SIGMAS, SHARPEST_STAR_PX
from namod_ctl.imaging.star_candidates import first_look
from namod_ctl.imaging.star_profile import measure_profile
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

MAX_SPOTS = 6
FAINTER_SHARE = 0.1
"""Spots fainter than that share of a frame's brightest one are not measured."""
APERTURE_STARS, APERTURE_DIAMETERS, SMALLEST_APERTURE_PX = 2.0, 1.5, 6.0
MAX_DIAMETER = 6.0
"""Times the star's size: a star that trails through a long exposure is longer than it is wide."""
N_TRIALS = 400
TOLERANCE_PX, TOLERANCE_SHARE = 4.0, 0.01
"""Distance from a parabola through three spots up to which a spot lies on the path; the second of its length."""
RIVAL_FRAMES, RIVAL_PEAK = 0.5, 0.4
"""Another star in half as many frames, less than one magnitude fainter: nobody can tell which one is meant."""
MAX_SATURATED_SHARE = 0.2
STANDING_PX = 2.0
MIN_STANDING_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class TrailSpot:
    """Something in a frame that could be a star."""

    x_px: float
    y_px: float
    uncertainty_px: float
    peak_adu: float
    is_saturated: bool


@dataclass(frozen=True, slots=True, eq=False)
class FoundTrail:
    """The star's trail, and the frames (by their place in the series) it was seen in; how many hold it saturated."""

    trail: Trail
    frames: NDArray[np.intp]
    n_saturated: int


def trail_spots(frame: Frame, camera: CameraModel, star_size_rad: float, exposure_s: float) -> list[TrailSpot]:
    """What could be a star in a frame of `camera`, brightest first.

    Raises
    ------
    ConfigError
        The frame is not one of this camera.
    DataQualityError
        It is saturated all over.
    """
    full_scale_adu, saturated_adu = camera.full_scale_adu, saturation_adu(camera)
    grey = grey_frame(without_dark(frame, camera, exposure_s), saturated_adu)
    size_px = star_size_rad / camera.plate_scale_rad
    look = first_look(grey, size_px, full_scale_adu, fainter_share=FAINTER_SHARE)
    if look.sky_adu >= saturated_adu:
        raise DataQualityError(f"the sky itself is saturated ({look.sky_adu:.0f} of {full_scale_adu:.0f})")
    table = response_table(camera, grey.dtype)
    found: list[TrailSpot] = []
    for spot in look.spots[: 2 * MAX_SPOTS]:
        if spot.diameter_px > MAX_DIAMETER * size_px or len(found) == MAX_SPOTS:
            continue
        aperture_px = max(APERTURE_STARS * size_px, APERTURE_DIAMETERS * spot.diameter_px, SMALLEST_APERTURE_PX)
        profile = measure_profile(grey, spot.x_px, spot.y_px, spot.diameter_px, aperture_px, table)
        to_edge_px = min(
            profile.x_px, profile.y_px, camera.n_columns - 1 - profile.x_px, camera.n_rows - 1 - profile.y_px
        )
        is_star = (
            profile.peak_adu > MIN_SIGMAS * profile.noise_adu
            and profile.diameter_px >= max(MIN_DIAMETER * size_px, SHARPEST_STAR_PX)
            and math.isfinite(profile.uncertainty_px)
            and to_edge_px > profile.aperture_px
        )
        if is_star and not any(math.hypot(profile.x_px - f.x_px, profile.y_px - f.y_px) < size_px for f in found):
            is_saturated = profile.brightest_adu >= saturated_adu
            found.append(TrailSpot(profile.x_px, profile.y_px, profile.uncertainty_px, profile.peak_adu, is_saturated))
    return found


def find_trail(time_s: Array, spots: Sequence[Sequence[TrailSpot]]) -> FoundTrail:
    """The trail of the one star that moves through a series of frames; `time_s` (n_frames,) ascend.

    Raises
    ------
    DataQualityError
        No star, none that moves, two that do, or a saturated one.
    """
    owner = np.array([i for i, seen in enumerate(spots) for _ in seen], dtype=np.intp)
    flat = [spot for seen in spots for spot in seen]
    if len(set(owner.tolist())) < MIN_POINTS:
        raise DataQualityError(
            f"a star is seen in {len(set(owner.tolist()))} of {len(spots)} frames, at least {MIN_POINTS} are needed: "
            "clouds, or the exposure is too short; record anew, on a brighter star"
        )
    position = np.array([(spot.x_px, spot.y_px) for spot in flat])
    peak = np.array([spot.peak_adu for spot in flat])
    best = _path(time_s, owner, position, peak, np.arange(len(flat)))
    if len(best) < MIN_POINTS:
        _refuse_standing(owner, position, len(spots))
        raise DataQualityError(
            "no star moves steadily through the frames: wind, a drive that moves, wrong times, or clouds; stop the "
            "drive and record anew"
        )
    rest = np.setdiff1d(np.arange(len(flat)), best)
    rival = _path(time_s, owner, position, peak, rest)
    if len(rival) > RIVAL_FRAMES * len(best) and np.median(peak[rival]) > RIVAL_PEAK * np.median(peak[best]):
        here, there = (np.median(position[chosen], axis=0) for chosen in (best, rival))
        raise DataQualityError(
            f"two stars of similar brightness trail through the frames, about x = {here[0]:.0f}, y = {here[1]:.0f} and "
            f"x = {there[0]:.0f}, y = {there[1]:.0f}: nobody can tell which one is meant; choose a star "
            "that stands alone"
        )
    n_saturated = sum(flat[k].is_saturated for k in best)
    if n_saturated > MAX_SATURATED_SHARE * len(best):
        raise DataQualityError(
            f"the star is saturated in {n_saturated} of {len(best)} frames: shorten the exposure and record anew"
        )
    kept = np.array([k for k in best if not flat[k].is_saturated], dtype=np.intp)
    uncertainty_px = np.array([flat[k].uncertainty_px for k in kept])
    trail = Trail(time_s[owner[kept]], position[kept], uncertainty_px)
    return FoundTrail(trail, owner[kept], n_saturated)


def _path(
    time_s: Array, owner: NDArray[np.intp], position: Array, peak: Array, among: NDArray[np.intp]
) -> NDArray[np.intp]:
    """The spots, at most one of a frame, on the parabola over time with most light on it; nothing that stands still."""
    frames = np.unique(owner[among])
    best: NDArray[np.intp] = np.empty(0, dtype=np.intp)
    if len(frames) < 3:
        return best
    rng = np.random.default_rng(0)  # the same frames must give the same result
    thirds = np.array_split(frames, 3)
    for _ in range(N_TRIALS):
        chosen = [int(rng.choice(among[owner[among] == rng.choice(third)])) for third in thirds]
        on_path = _near_parabola(time_s, owner, position, among, np.array(chosen))
        if peak[on_path].sum() > peak[best].sum():
            best = on_path
    return best


def _near_parabola(
    time_s: Array, owner: NDArray[np.intp], position: Array, among: NDArray[np.intp], through: NDArray[np.intp]
) -> NDArray[np.intp]:
    scaled = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    curve = np.linalg.lstsq(_powers(scaled[owner[through]]), position[through], rcond=None)[0]
    ends = _powers(np.array([scaled[owner[among].min()], scaled[owner[among].max()]])) @ curve
    length_px = float(np.linalg.norm(ends[1] - ends[0]))
    if length_px < MIN_LENGTH_PX:
        return np.empty(0, dtype=np.intp)
    miss_px = np.linalg.norm(position[among] - _powers(scaled[owner[among]]) @ curve, axis=1)
    near = among[miss_px < max(TOLERANCE_PX, TOLERANCE_SHARE * length_px)]
    order = near[np.argsort(miss_px[np.searchsorted(among, near)], kind="stable")]
    _, first = np.unique(owner[order], return_index=True)
    nearest: NDArray[np.intp] = order[first]
    return nearest


def _powers(time: Array) -> Array:
    return np.column_stack([np.ones_like(time), time, time**2])


def _refuse_standing(owner: NDArray[np.intp], position: Array, n_frames: int) -> None:
    """Raise DataQualityError when something shines at the same place in most frames."""
    for place in position:
        is_here = np.linalg.norm(position - place, axis=1) < STANDING_PX
        n_here = len(np.unique(owner[is_here]))
        if n_here > MIN_STANDING_SHARE * n_frames:
            raise DataQualityError(
                f"the star stands still at x = {place[0]:.0f}, y = {place[1]:.0f} in {n_here} of {n_frames} frames: "
                "the drive tracks; stop it, so that the star trails through the field, and record anew"
            )
