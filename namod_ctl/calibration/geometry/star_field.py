"""All stars of a frame, and of several frames of the same field, as the catalogue search wants them.

Stars are found and measured with the tools of the one-star finder. What is sharper than a star can be is a hot pixel
and left out here; what is as wide as a star and yet none is left to the catalogue.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from namod_ctl.calibration.geometry.star_search import MIN_STARS, SeenStars
from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.dark import repair_pixels
from namod_ctl.imaging.radiometry import Frame, checked_frame, grey_frame, response_table, saturation_adu
from namod_ctl.imaging.star import (
    APERTURE_RADIUS,
    APERTURE_RADIUS_OF_BROAD_STAR,
    DOMINANCE_SHARE,
    HUGE_DIAMETER,
    MAX_DIAMETER,
    MAX_ELONGATION,
    MIN_DIAMETER,
    MIN_SIGMAS,
    SHARPEST_STAR_PX,
    SMALLEST_APERTURE_PX,
    STREAK_ELONGATION,
    STREAK_LENGTH,
)
from namod_ctl.imaging.star_candidates import MAX_SPOT_SHARE, Spot, first_look
from namod_ctl.imaging.star_profile import Profile, measure_profile
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

MAX_SPOTS = 300
"""The brightest spots of a frame that are looked at closely: the catalogue's stars are far fewer."""

MAX_DRIFT_SHARE = 0.005
"""Of the diagonal of the image: how far a field may move between frames of the same calibration. The mean of a star's
places then is its place in a frame of the mean direction, within 0.01 px at the corner of a lens that bends by 1 %."""

DRIFT_TOLERANCE_PX = 3.0
"""The stars of two frames follow one another so well after the common drift is taken out."""

N_DRIFT_STARS = 25

COMMON_SHARE = 0.6
"""So many of the bright stars of a frame must be those of the others."""

SEEN_SHARE = 0.5
"""A star counts when at least this share of the frames shows it."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameStars:
    """The stars of one frame, brightest first, and what else it shows.

    Attributes
    ----------
    stars
        Magnitudes are of the camera's own law, with an arbitrary zero point.
    n_streaks, n_saturated, n_sharp
        Streaks, saturated stars (these are among the stars, as not exact) and hot pixels that were told from stars.
    """

    stars: SeenStars
    n_streaks: int
    n_saturated: int
    n_sharp: int


def stars_of_frame(frame: Frame, camera: CameraModel, star_size_rad: float) -> FrameStars:
    """Every star of a frame of that camera.

    Raises
    ------
    ConfigError
        It is no frame of this camera.
    DataQualityError
        It is so bright that no star could be told.
    """
    frame = grey_frame(checked_frame(frame, camera), saturation_adu(camera))
    if camera.dark is not None and camera.dark.hot_pixels.size:
        is_hot = np.zeros(frame.shape, dtype=np.bool_)
        is_hot[camera.dark.hot_pixels[:, 1], camera.dark.hot_pixels[:, 0]] = True
        frame = repair_pixels(frame, is_hot)
    size_px = star_size_rad / camera.plate_scale_rad
    look = first_look(frame, size_px, camera.full_scale_adu, fainter_share=0.0)
    if look.sky_adu >= saturation_adu(camera) or look.bright_share > MAX_SPOT_SHARE:
        raise DataQualityError(
            f"the sky is at {look.sky_adu:.0f} of {camera.full_scale_adu:.0f}, and {look.bright_share:.0%} of the "
            f"frame stands above it (limit {MAX_SPOT_SHARE:.0%}): expose shorter, and without moon, clouds and lamps"
        )
    profiles: list[Profile] = []
    n_sharp, n_streaks = look.n_isolated, 0
    for spot in look.spots[:MAX_SPOTS]:
        if _is_streak(spot, size_px):
            n_streaks += 1
            continue
        if spot.diameter_px > HUGE_DIAMETER * size_px:
            continue
        profile = _profile(frame, spot, camera, size_px)
        if profile.diameter_px < max(MIN_DIAMETER * size_px, SHARPEST_STAR_PX):
            n_sharp += 1
        elif profile.elongation > MAX_ELONGATION:
            n_streaks += 1
        elif _is_star(profile, frame, size_px) and not _is_known(profile, profiles):
            profiles.append(profile)
    profiles.sort(key=lambda profile: -profile.intensity_sum)
    is_saturated = np.array([star.brightest_adu >= saturation_adu(camera) for star in profiles], dtype=np.bool_)
    has_companion = np.array([star.companion_share > DOMINANCE_SHARE for star in profiles], dtype=np.bool_)
    stars = SeenStars(
        pixel=np.array([(star.x_px, star.y_px) for star in profiles]).reshape(-1, 2),
        error_px=np.array([star.uncertainty_px for star in profiles]),
        magnitude=np.array([-2.5 * math.log10(star.intensity_sum) for star in profiles]),
        is_exact=~is_saturated & ~has_companion,
    )
    return FrameStars(stars, n_streaks, int(is_saturated.sum()), n_sharp)


def _is_streak(spot: Spot, size_px: float) -> bool:
    return spot.elongation > STREAK_ELONGATION and spot.length_px > STREAK_LENGTH * size_px


def _profile(frame: Frame, spot: Spot, camera: CameraModel, size_px: float) -> Profile:
    aperture_px = max(APERTURE_RADIUS * size_px, APERTURE_RADIUS_OF_BROAD_STAR * spot.diameter_px, SMALLEST_APERTURE_PX)
    table = response_table(camera, frame.dtype)
    return measure_profile(frame, spot.x_px, spot.y_px, spot.diameter_px, aperture_px, table)


def _is_star(star: Profile, frame: Frame, size_px: float) -> bool:
    """Bright, narrow and whole enough."""
    to_edge_px = min(star.x_px, star.y_px, frame.shape[1] - 1 - star.x_px, frame.shape[0] - 1 - star.y_px)
    return (
        star.peak_adu >= MIN_SIGMAS * star.noise_adu
        and star.diameter_px <= MAX_DIAMETER * size_px
        and star.intensity_sum > 0.0
        and math.isfinite(star.uncertainty_px)
        and to_edge_px >= star.aperture_px
    )


def _is_known(star: Profile, others: list[Profile]) -> bool:
    """A faint spot beside a star may have led to the star itself."""
    return any(math.hypot(star.x_px - other.x_px, star.y_px - other.y_px) < 0.5 * star.diameter_px for other in others)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """The stars of several frames of one field as one.

    Attributes
    ----------
    stars
        In the pixels of a frame of the frames' mean direction.
    drift_px
        Shape (n_frames, 2): how far the field stands from there in each frame.
    n_streaks, n_saturated, n_sharp
        As in `FrameStars`, the largest of all frames.
    """

    stars: SeenStars
    drift_px: Array
    n_streaks: int
    n_saturated: int
    n_sharp: int


def field_of_frames(frames: list[FrameStars], names: list[str], camera: CameraModel) -> Field:
    """The stars that the frames have in common, their places averaged.

    Raises
    ------
    DataQualityError
        Frames without enough stars, or of different fields; their `names` are told.
    """
    poor = [name for name, frame in zip(names, frames, strict=True) if len(frame.stars.pixel) < MIN_STARS]
    if poor:
        raise DataQualityError(_too_few(frames, names, poor))
    limit_px = MAX_DRIFT_SHARE * math.hypot(camera.n_columns, camera.n_rows)
    first = frames[0].stars
    moves, fields = [], []
    for frame in frames:
        drift = _drift(first, frame.stars, limit_px)
        fields.append(drift is not None)
        moves.append(np.zeros(2) if drift is None else drift)
    if not all(fields):
        strange = [name for name, is_same in zip(names, fields, strict=True) if not is_same]
        raise DataQualityError(
            f"the frames do not show the same field: {_listed(strange)} other stars than {names[0]} (or moved by more "
            f"than {limit_px:.0f} px); give the frames of one field, taken one after the other, and calibrate each "
            "field by itself"
        )
    drift_px = np.array(moves) - np.mean(moves, axis=0)
    return Field(
        _averaged(frames, drift_px),
        drift_px,
        max(frame.n_streaks for frame in frames),
        max(frame.n_saturated for frame in frames),
        max(frame.n_sharp for frame in frames),
    )


def _too_few(frames: list[FrameStars], names: list[str], poor: list[str]) -> str:
    worst = min(frames, key=lambda frame: len(frame.stars.pixel))
    text = (
        f"{len(worst.stars.pixel)} star(s) in {names[frames.index(worst)]} (needed: {MIN_STARS + 1}, better 8"
        + (f"; as few in {len(poor) - 1} other frame(s)" if len(poor) > 1 else "")
        + ")"
    )
    if worst.n_streaks:
        return f"{text}, but {worst.n_streaks} streak(s): let the telescope track, or use 'namod-ctl calibrate trail'"
    return f"{text}: clouds? Otherwise expose longer, focus, or choose a field with more bright stars"


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:5])
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{shown}{more} {'shows' if len(names) == 1 else 'show'}"


def _drift(first: SeenStars, other: SeenStars, limit_px: float) -> Array | None:
    """How far the bright stars of `other` have moved together; None when they are not the same stars."""
    one, two = first.pixel[:N_DRIFT_STARS], other.pixel[:N_DRIFT_STARS]
    moves = (two[:, None, :] - one[None, :, :]).reshape(-1, 2)
    moves = moves[np.linalg.norm(moves, axis=1) <= limit_px]
    if len(moves) == 0:
        return None
    votes = cKDTree(moves).query_ball_point(moves, DRIFT_TOLERANCE_PX)
    best = max(votes, key=len)
    if len(best) < max(MIN_STARS - 1, COMMON_SHARE * min(len(one), len(two))):
        return None
    return np.asarray(np.median(moves[best], axis=0), dtype=np.float64)


def _averaged(frames: list[FrameStars], drift_px: Array) -> SeenStars:
    """Stars that at least `SEEN_SHARE` of the frames show, weighted means of their places less the drift."""
    places = np.concatenate([frame.stars.pixel - drift for frame, drift in zip(frames, drift_px, strict=True)])
    number = np.repeat(np.arange(len(frames)), [len(frame.stars.pixel) for frame in frames])
    error = np.concatenate([frame.stars.error_px for frame in frames])
    magnitude = np.concatenate([frame.stars.magnitude for frame in frames])
    is_exact = np.concatenate([frame.stars.is_exact for frame in frames])
    tree = cKDTree(places)
    is_free = np.ones(len(places), dtype=np.bool_)
    rows = []
    for start in np.lexsort((number, magnitude)):
        if not is_free[start]:
            continue
        members = np.array([i for i in tree.query_ball_point(places[start], DRIFT_TOLERANCE_PX) if is_free[i]])
        is_free[members] = False
        if len(np.unique(number[members])) < SEEN_SHARE * len(frames):
            continue
        weight = error[members] ** -2.0
        x, y = weight @ places[members] / weight.sum()
        rows.append((x, y, weight.sum() ** -0.5, np.median(magnitude[members]), is_exact[members].all()))
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    table = table[np.argsort(table[:, 3], kind="stable")]
    return SeenStars(table[:, :2], table[:, 2], table[:, 3], table[:, 4] == 1.0)
