"""From the stars of a field to the geometry of the star camera, with its uncertainties and what it is not good for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.geometry.plate_solution import (
    K1,
    K1_OF_TANGENT,
    lens_priors,
    rotation_at,
    rotation_uncertainty_rad,
)
from namod_ctl.calibration.geometry.star_match import known_stars, match_field
from namod_ctl.calibration.geometry.star_search import FieldMatch, KnownStars, SeenStars
from namod_ctl.calibration.sky.observed_sky import Site, julian_year, observed_directions
from namod_ctl.calibration.sky.star_catalogue import StarCatalogue
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

AIR_AND_MOTION_SHARE = 6e-4
"""Of the plate scale, without time and site: air presses a field together by 2e-4 (zenith, high site) to 1.1e-3 (60 deg
from zenith, sea level, in height), the Earth's motion stretches or presses it by 1e-4."""

GOOD_SHARE = 2.0e-4
"""Of the plate scale: 0.0005 of 2.437 mdeg per pixel. What is less certain is "limited"."""

WORST_SHARE = 2e-3
"""What is less certain than this is worse than a config that somebody has once measured: refused."""

GOOD_ROTATION_RAD = deg_to_rad(0.01)
WORST_RMS_PX, GOOD_RMS_PX = 1.0, 0.3

CLOCK_ERROR_S = 1.0
"""How well the time is taken to be known; UT1 differs from UTC by less than this."""

SIDEREAL_RAD_PER_S = 7.292e-5

AXIS_ERROR_PX = 1.0
"""Of a calibrated axis."""

NOMINAL_AXIS_ERROR_SHARE = 0.01
"""Of the image's width: one that is only taken to be in the middle."""

SURPRISING_ROTATION_RAD = deg_to_rad(2.0)
SIGNIFICANT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Watch:
    """When and where the frames were taken; both are needed to take air and motion out."""

    moment: datetime
    site: Site | None


@dataclass(frozen=True, slots=True, eq=False)
class Hint:
    """Roughly where the camera looked: unit vector (3,) in ICRS, and within which angle of it the field's middle is."""

    direction: Array
    radius_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class FieldGeometry:
    """The camera as the field shows it.

    Attributes
    ----------
    rotation_rad, rotation_uncertainty_rad
        None without time and site.
    axis_direction
        Shape (3,): where the telescope's axis pointed; in the horizon's frame (north, west, up) with a rotation, else
        ICRS.
    match, known
        What was recognized.
    verdict, remarks
        "limited" where the remarks say what it is not good for.
    """

    plate_scale_uncertainty_rad: float
    rotation_rad: float | None
    rotation_uncertainty_rad: float | None
    axis_direction: Array
    match: FieldMatch
    known: KnownStars
    verdict: Literal["good", "limited"]
    remarks: tuple[str, ...]


def solve_field(
    stars: SeenStars,
    catalogue: StarCatalogue,
    camera: CameraModel,
    star_size_rad: float,
    watch: Watch,
    hint: Hint | None = None,
) -> FieldGeometry:
    """The geometry of a camera whose frames show these stars.

    Parameters
    ----------
    camera
        As the config describes it: its plate scale must be right within 10 %; rotation, mirroring and distortion are
        not looked at, but for remarks.

    Raises
    ------
    DataQualityError
        The field is not recognized beyond doubt, or tells the plate scale too badly to be of use.
    """
    with_air = watch.site is not None
    true_directions = catalogue.directions(julian_year(watch.moment))
    directions = observed_directions(catalogue, watch.moment, watch.site) if watch.site is not None else true_directions
    if hint is not None:
        reach_rad = hint.radius_rad + 0.6 * camera.plate_scale_rad * math.hypot(camera.n_columns, camera.n_rows)
        directions = np.where((true_directions @ hint.direction >= math.cos(reach_rad))[:, None], directions, np.nan)
    known = known_stars(directions, catalogue.v_mag, catalogue.is_disturbed, star_size_rad)
    try:
        match = match_field(stars, known, camera, lens_priors(camera))
    except DataQualityError as problem:
        if with_air and len(stars.pixel) >= 4:
            raise DataQualityError(f"{problem}. Only stars above the horizon were tried: is --time UTC?") from None
        raise
    plate, fit = match.fit.plate, match.fit
    share = fit.plate_scale_uncertainty_rad / plate.plate_scale_rad
    if share > WORST_SHARE or fit.rms_px > WORST_RMS_PX:
        raise DataQualityError(
            f"the field was recognized by {len(match.seen)} stars, but they tell the plate scale only to {share:.1%} "
            f"and scatter by {fit.rms_px:.2f} px (limits {WORST_SHARE:.1%}, {WORST_RMS_PX:g} px): take frames of a "
            "field with more bright stars, all over the image, sharp and without wind"
        )
    remarks: list[str] = []
    scale_error = share
    rotation = uncertainty = None
    if with_air:
        rotation, uncertainty = _rotation(match, camera, watch, directions)
    else:
        scale_error = math.hypot(share, AIR_AND_MOTION_SHARE)
        remarks.append(
            "without time and site the air's pressing of the field and the rotation in the telescope frame are not "
            "known: give --time and [site] (or --site)"
        )
    scale_remarks, is_good = _remarks(match, camera, scale_error, rotation, uncertainty)
    return FieldGeometry(
        scale_error * plate.plate_scale_rad,
        rotation,
        uncertainty,
        plate.directions_of(camera.axis_pixel),
        match,
        known,
        "good" if is_good else "limited",
        (*remarks, *scale_remarks),
    )


def _rotation(match: FieldMatch, camera: CameraModel, watch: Watch, directions: Array) -> tuple[float, float]:
    """The camera's rotation and one standard deviation, rad."""
    assert watch.site is not None
    axis_error_px = (
        AXIS_ERROR_PX if camera.axis_is_calibrated else max(AXIS_ERROR_PX, NOMINAL_AXIS_ERROR_SHARE * camera.n_columns)
    )
    plate = match.fit.plate
    axis = plate.directions_of(camera.axis_pixel)
    # How fast the field turns about the axis: omega cos(latitude) cos(azimuth) / cos(altitude).
    across = math.hypot(axis[0], axis[1])
    turning = SIDEREAL_RAD_PER_S * math.cos(watch.site.latitude_rad) * float(axis[0]) / across**2
    of_stars = rotation_uncertainty_rad(match.fit, camera.axis_pixel, axis_error_px)
    return rotation_at(plate, camera.axis_pixel), math.hypot(of_stars, CLOCK_ERROR_S * turning)


def _remarks(
    match: FieldMatch, camera: CameraModel, scale_error: float, rotation: float | None, uncertainty: float | None
) -> tuple[list[str], bool]:
    """What a person should know, and whether nothing limits the result."""
    remarks, is_good = [], True
    plate, fit = match.fit.plate, match.fit
    mdeg = rad_to_mdeg(plate.plate_scale_rad)
    if scale_error > GOOD_SHARE:
        is_good = False
        remarks.append(
            f"the plate scale is known to {scale_error * mdeg:.4f} mdeg per pixel only (good: {GOOD_SHARE * mdeg:.4f}):"
            " more frames, and a field with more bright stars all over the image, help"
        )
    if fit.rms_px > GOOD_RMS_PX:
        is_good = False
        remarks.append(
            f"the stars scatter by {fit.rms_px:.2f} px (good: {GOOD_RMS_PX:g}): wind, focus, or a lens that bends oddly"
        )
    if uncertainty is not None and uncertainty > GOOD_ROTATION_RAD:
        is_good = False
        cause = "" if camera.axis_is_calibrated else "; calibrate the optical axis first ('namod-ctl calibrate axis')"
        remarks.append(
            f"the rotation is known to {rad_to_deg(uncertainty):.3f} deg only (good: {rad_to_deg(GOOD_ROTATION_RAD):g})"
            f"{cause}; at low altitude it is known better"
        )
    if rotation is not None:
        apart = math.remainder(rotation - camera.orientation.rotation_rad, 2.0 * math.pi)
        if abs(apart) > SURPRISING_ROTATION_RAD:
            remarks.append(
                f"the rotation differs from the config's by {rad_to_deg(apart):+.1f} deg: was the camera turned, or is "
                "the time not UTC?"
            )
    if plate.is_mirrored != camera.orientation.is_mirrored:
        remarks.append(
            f"the image is {'mirrored' if plate.is_mirrored else 'not mirrored'}; the config says the opposite"
        )
    if match.strangers.size:
        remarks.append(
            f"{match.strangers.size} light(s) as bright as the matched stars are in no catalogue: hot pixels, planets"
        )
    if match.missing.size:
        remarks.append(f"{match.missing.size} catalogue star(s) that should be in the image were not seen: clouds?")
    dropped = int((~fit.is_used).sum())
    if dropped:
        remarks.append(f"{dropped} star(s) stand out of the fit and were left out: doubles, or moving things")
    return remarks, is_good


def bend_in_words(geometry: FieldGeometry, camera: CameraModel) -> str:
    """How much the lens bends the image at its corners, beyond a perfect lens, and whether that is seen at all."""
    fit = geometry.match.fit
    corner_rad = 0.5 * fit.plate.plate_scale_rad * math.hypot(camera.n_columns, camera.n_rows)
    bend, error = fit.plate.k1_per_rad2 - K1_OF_TANGENT, math.sqrt(fit.covariance[K1, K1])
    text = f"{bend * corner_rad**2:+.2%} +- {error * corner_rad**2:.2%} at the corners"
    return text if abs(bend) > SIGNIFICANT_SIGMAS * error else f"none seen ({text})"
