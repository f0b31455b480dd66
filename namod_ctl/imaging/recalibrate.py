"""Records of a run put on other calibrations of its cameras without its frames, as far as numbers alone allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from namod_ctl.core.records import Record
from namod_ctl.optics.camera_model import CameraModel, DarkModel
from namod_ctl.optics.instrument import Instrument


def why_frames_are_needed(old: CameraModel, new: CameraModel) -> tuple[str, ...]:
    """What changed between two calibrations of a camera that only its frames can follow; empty when numbers will do."""
    reasons = []
    if (old.law.r_resp, old.law.r_curve) != (new.law.r_resp, new.law.r_curve):
        reasons.append("the law's response (r_resp, r_curve)")
    if old.saturation_share != new.saturation_share:
        reasons.append("the point of saturation")
    if not _is_same_dark(old.dark, new.dark):
        reasons.append("the dark level and hot pixels")
    return tuple(reasons)


def recalibrated(record: Record, old: Instrument, new: Instrument) -> Record:
    """The record as the cameras of `new` would have given it, of a run of the cameras of `old`.

    Exact where `why_frames_are_needed` names nothing: the star's pixel follows from its direction, and intensities
    change by one factor of the exposure.
    """
    pixel = old.star_camera.pixel_of_theta(record.theta_rad)
    theta_rad = new.star_camera.theta_of_pixel(pixel) if np.all(np.isfinite(pixel)) else record.theta_rad
    scale = new.star_camera.plate_scale_rad / old.star_camera.plate_scale_rad
    return replace(
        record,
        theta_rad=theta_rad,
        theta_uncertainty_rad=record.theta_uncertainty_rad * scale,
        star_intensity=record.star_intensity * _factor(old.star_camera, new.star_camera, record.star_exposure_s),
        facet_intensity=record.facet_intensity
        * _factor(old.reflector_camera, new.reflector_camera, record.reflector_exposure_s),
    )


def _factor(old: CameraModel, new: CameraModel, exposure_s: float) -> float:
    """NaN for an unknown exposure that matters."""
    exponent = new.law.r_expo - old.law.r_expo
    by_exposure = 1.0 if exponent == 0.0 else exposure_s**exponent
    return float(by_exposure * 10.0 ** (new.law.r_const - old.law.r_const))


def _is_same_dark(old: DarkModel | None, new: DarkModel | None) -> bool:
    if old is None or new is None:
        return old is new
    levels = (old.bias_adu, old.rate_adu_per_s) == (new.bias_adu, new.rate_adu_per_s)
    return levels and np.array_equal(old.hot_pixels, new.hot_pixels)
