"""Plate scale, rotation and parity of the star camera from a star that trails while the drive stands still.

The sky turns at a rate that is known to nine digits: a star moves on the small circle of its declination by 15.041
arcsec of hour angle per second. Every frame with a time so is a mark on a ruler in the sky. The path on the sphere is
exact (`star_path`), its curvature included; what is fitted is how the camera stands (three angles), its plate scale,
and the first term of its lens' distortion.

What one trail cannot tell: a wrong declination, a clock at a wrong rate and a drive that creeps at a steady rate all
look like another plate scale. Only the curvature of the trail disagrees then, and it is compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.geometry.trail_solution import (
    DECLINATION,
    K1,
    LOG_SCALE,
    MIN_POINTS,
    NORMAL_PER_MAD,
    Mask,
    Solution,
    Trail,
    roll_uncertainty_rad,
    solve_trail,
    turned_camera,
)
from namod_ctl.calibration.sky.star_path import StarPath
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

MIN_LENGTH_PX = 50.0
"""Of a trail: a star that moves less within a series stands still, or the series is too short for anything."""
MAX_SCALE_CHANGE = 0.3
"""Of the config's plate scale: further off, something else is wrong than the plate scale."""
CLOCK_UNCERTAINTY = 5e-5
"""Relative: the rate of a quartz clock that nobody disciplines."""
SIGNIFICANT = 4.0
"""Standard deviations from which on a distortion is told."""
PARITY_CHI2 = 25.0
"""Less of chi^2 that the one parity must have, or nobody can tell."""
INCONSISTENT, DOUBTFUL = 5.0, 3.0
"""Standard deviations between the declination that the curvature shows and the one that was given."""
MAX_SCATTER_PX = 3.0
"""A star that jumps about more than that across its path: wind, or a drive that is not at rest."""
SHAKEN_PX = 0.5
JITTER_SHARE, JITTER_PX = 2.0, 0.1
"""So much more scatter along the path than across it comes from the times of the frames."""
MAX_BLIND_RAD = deg_to_rad(5.0)
"""Uncertainty of the declination from the curvature beyond which it confirms nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class TrailFit:
    """The camera as a trail shows it.

    Attributes
    ----------
    camera
        With the fitted plate scale, and with distortion, rotation and parity as far as the trail tells them.
    plate_scale_uncertainty_rad
        One standard deviation, of everything: noise, times, refraction, lens.
    k1_per_rad2, k1_uncertainty_per_rad2
        Of the distortion, significant or not.
    has_distortion
        It is significant.
    is_mirrored
        None when the trail is too straight to tell.
    rotation_uncertainty_rad
        NaN when the rotation cannot be told: site or times are not known.
    direction_rad
        Of the star's motion in the middle of the trail, from the image's columns (to the right) counter-clockwise.
    seen_declination_rad, seen_declination_uncertainty_rad
        That the trail's curvature shows.
    residual_px
        Shape (n, 2). Along the motion and across it.
    is_used
        Shape (n,). False where a frame disagrees with all others.
    noise_factor
        How many times the variance of the mean is larger than that of independent frames.
    remarks
        What a person should know.
    doubts
        What makes it a calibration of limited use.
    """

    camera: CameraModel
    plate_scale_uncertainty_rad: float
    k1_per_rad2: float
    k1_uncertainty_per_rad2: float
    has_distortion: bool
    is_mirrored: bool | None
    rotation_uncertainty_rad: float
    direction_rad: float
    seen_declination_rad: float
    seen_declination_uncertainty_rad: float
    residual_px: Array
    is_used: Mask
    noise_factor: float
    remarks: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def rms_px(self) -> Array:
        """Shape (2,): scatter along the motion and across it."""
        rms: Array = np.sqrt(np.mean(self.residual_px[self.is_used] ** 2, axis=0))
        return rms


def fit_trail(trail: Trail, path: StarPath, camera: CameraModel) -> TrailFit:
    """Plate scale and more of `camera`, whose config gives the first guess, from a trail and the star's true path.

    Raises
    ------
    DataQualityError
        There is no use in this trail: too short or too few points, no steady motion, or a curvature that is not that
        of the given declination.
    """
    _check_trail(trail)
    mirrored = replace(camera, orientation=replace(camera.orientation, is_mirrored=not camera.orientation.is_mirrored))
    own, other = solve_trail(trail, path, camera), solve_trail(trail, path, mirrored)
    better, worse = sorted((own, other), key=lambda solution: float(np.median(np.abs(solution.residual_px))))
    _check_scatter(better)
    best, is_mirrored = own, None
    if better.chi2_of(worse.residual_px) - better.chi2_of(better.residual_px) > PARITY_CHI2:
        best, is_mirrored = better, better.camera.orientation.is_mirrored
    rotation_uncertainty = math.nan
    if path.has_zenith:
        best = solve_trail(
            trail, path, turned_camera(best)
        )  # Theta bends along the telescope's own axes: they must be known
        # air that squeezes the sky otherwise than thought turns the trail by as much
        rotation_uncertainty = math.hypot(roll_uncertainty_rad(best, path), path.rate_uncertainty)
        best = replace(best, camera=turned_camera(best))
    _check_scale(best, camera)
    declination, declination_uncertainty = _seen_declination(trail, path, best)
    doubts = [
        *_declination_doubts(path, declination, declination_uncertainty),
        *_parity_doubts(camera, is_mirrored, path),
    ]
    k1, k1_uncertainty = float(best.parameters[K1]), math.sqrt(best.covariance[K1, K1])
    fitted = best.fitted
    assert fitted.distortion is not None
    bend, known = fitted.distortion, camera.distortion
    has_distortion = known is not None or abs(k1) > SIGNIFICANT * k1_uncertainty
    fitted = replace(fitted, distortion=bend if has_distortion else None, orientation=best.camera.orientation)
    relative = math.hypot(math.sqrt(best.covariance[LOG_SCALE, LOG_SCALE]), path.rate_uncertainty, CLOCK_UNCERTAINTY)
    return TrailFit(
        camera=fitted,
        plate_scale_uncertainty_rad=fitted.plate_scale_rad * relative,
        k1_per_rad2=k1,
        k1_uncertainty_per_rad2=k1_uncertainty,
        has_distortion=has_distortion,
        is_mirrored=is_mirrored,
        rotation_uncertainty_rad=rotation_uncertainty,
        direction_rad=_direction_rad(trail, best.is_used),
        seen_declination_rad=declination,
        seen_declination_uncertainty_rad=declination_uncertainty,
        residual_px=best.residual_px,
        is_used=best.is_used,
        noise_factor=best.noise_factor,
        remarks=tuple(_remarks(camera, is_mirrored, best, trail, has_rotation=path.has_zenith)),
        doubts=tuple(doubts),
    )


def _seen_declination(trail: Trail, path: StarPath, best: Solution) -> tuple[float, float]:
    """Declination that the curvature shows, and its uncertainty, rad."""
    free = solve_trail(trail, path, best.camera, has_free_declination=True)
    uncertainty = math.hypot(math.sqrt(free.covariance[DECLINATION, DECLINATION]), path.curvature_uncertainty_rad)
    return path.declination_rad + float(free.parameters[DECLINATION]), uncertainty


def _direction_rad(trail: Trail, is_used: Mask) -> float:
    time, pixel = trail.time_s[is_used], trail.pixel[is_used]
    x_rate, y_rate = np.polynomial.polynomial.polyfit(time - time.mean(), pixel - pixel.mean(axis=0), 1)[1]
    return math.atan2(-float(y_rate), float(x_rate))


def _check_trail(trail: Trail) -> None:
    n = len(trail.time_s)
    if n < MIN_POINTS:
        raise DataQualityError(
            f"the star was measured in {n} frames, at least {MIN_POINTS} are needed: take more frames of it"
        )
    length_px = float(np.linalg.norm(trail.pixel[-1] - trail.pixel[0]))
    if length_px < MIN_LENGTH_PX:
        raise DataQualityError(
            f"the star moves by {length_px:.1f} pixel within {trail.time_s[-1] - trail.time_s[0]:.0f} s (at least "
            f"{MIN_LENGTH_PX:.0f} are needed): stop the drive, or take frames for longer"
        )


def _check_scatter(best: Solution) -> None:
    scatter_px = NORMAL_PER_MAD * float(np.median(np.abs(best.residual_px[best.is_used, 1])))
    if scatter_px > MAX_SCATTER_PX:
        raise DataQualityError(
            f"the star scatters by {scatter_px:.1f} pixel about its path (limit {MAX_SCATTER_PX:g}): wind shakes the "
            "telescope, or the drive moves; park it, wait for calmer air and record anew"
        )


def _check_scale(best: Solution, camera: CameraModel) -> None:
    found, expected = best.fitted.plate_scale_rad, camera.plate_scale_rad
    if not 1.0 - MAX_SCALE_CHANGE < found / expected < 1.0 + MAX_SCALE_CHANGE:
        raise DataQualityError(
            f"the trail would mean {rad_to_mdeg(found):.3f} mdeg per pixel, the config says "
            f"{rad_to_mdeg(expected):.3f}: the drive moves (stop it), the times are wrong, it is another star; or the "
            "camera has another lens: then correct plate_scale_mdeg_per_px roughly and try again"
        )


def _parity_doubts(camera: CameraModel, is_mirrored: bool | None, path: StarPath) -> list[str]:
    if is_mirrored is None or is_mirrored == camera.orientation.is_mirrored or path.has_zenith:
        return []
    return ["the trail is curved to the other side than the config's parity says: either the image is "
            f"{'mirrored' if is_mirrored else 'not mirrored'}, or the declination has the wrong sign"]  # fmt: skip


def _declination_doubts(path: StarPath, seen_rad: float, uncertainty_rad: float) -> list[str]:
    given, seen, sigma = (float(rad_to_deg(angle)) for angle in (path.declination_rad, seen_rad, uncertainty_rad))
    off = abs(seen - given) / sigma
    text = f"the trail is curved as that of a star of declination {seen:.2f} +- {sigma:.2f} deg, given is {given:.2f}"
    if off > INCONSISTENT:
        raise DataQualityError(f"{text}: another star, a drive that moves, or wrong times; check these and record anew")
    if off > DOUBTFUL:
        return [f"{text}: check the star, and that the drive was stopped"]
    if uncertainty_rad > MAX_BLIND_RAD:
        return [
            f"too short for its curvature to confirm the declination (it shows {seen:.0f} +- {sigma:.0f} deg): the "
            "plate scale is wrong if the declination is"
        ]
    return []


def _remarks(
    camera: CameraModel, is_mirrored: bool | None, best: Solution, trail: Trail, *, has_rotation: bool
) -> list[str]:
    remarks = []
    if is_mirrored is None:
        taken = "; the rotation takes the config's word for it" if has_rotation else ""
        remarks.append(f"the trail is too straight to tell whether the image is mirrored{taken}")
    elif is_mirrored != camera.orientation.is_mirrored:
        remarks.append(f"the image is {'mirrored' if is_mirrored else 'not mirrored'}, against what the config says")
    along_px, across_px = (float(value) for value in np.std(best.residual_px[best.is_used], axis=0))
    n_out = int(np.count_nonzero(~best.is_used))
    if n_out:
        remarks.append(f"{n_out} frames disagree with the others and were left out")
    seconds_per_px = float(trail.time_s[-1] - trail.time_s[0]) / float(np.linalg.norm(trail.pixel[-1] - trail.pixel[0]))
    noise_px = max(across_px, float(np.median(trail.uncertainty_px)))
    if along_px > JITTER_SHARE * noise_px and along_px > JITTER_PX:
        jitter_s = math.sqrt(along_px**2 - noise_px**2) * seconds_per_px
        remarks.append(f"the frames' times scatter by {jitter_s:.2g} s")
    if across_px > SHAKEN_PX:
        remarks.append(f"the star scatters by {across_px:.2f} pixel about its path: wind")
    return remarks
