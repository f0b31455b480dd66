"""The values of calibrations in words, for tables that people read."""

from __future__ import annotations

import math
from collections.abc import Iterator

from namod_ctl.app.config.calibration_schema import (
    AxisCalibration,
    Calibration,
    DarkCalibration,
    GeometryCalibration,
    RadiometricCalibration,
)
from namod_ctl.core.units import mdeg_to_rad


def values_in_words(calibration: Calibration) -> Iterator[tuple[str, str]]:
    """Names and values with their uncertainties."""
    match calibration:
        case RadiometricCalibration():
            yield from _radiometric(calibration)
        case DarkCalibration():
            yield (
                "without light",
                (f"{calibration.bias_adu:.2f} adu {calibration.rate_adu_per_s:+.3f} adu per s of exposure"),
            )
            yield "read noise", f"{calibration.read_noise_adu:.2f} adu"
            yield "fixed pattern", f"{calibration.fixed_pattern_adu:.2f} adu"
            yield "hot pixels", str(len(calibration.hot_pixels))
        case GeometryCalibration():
            yield from _geometry(calibration)
        case AxisCalibration():
            x_px, y_px = calibration.axis_px
            sigma = [math.sqrt(calibration.covariance_px2[i][i]) for i in range(2)]
            yield "optical axis", f"column {x_px:.2f} +- {sigma[0]:.2f}, row {y_px:.2f} +- {sigma[1]:.2f}"
            yield "method", calibration.method
            for zenith_deg, x_px, y_px in calibration.over_zenith:
                yield "", f"at {zenith_deg:.0f} deg from zenith: column {x_px:.2f}, row {y_px:.2f}"


def _radiometric(calibration: RadiometricCalibration) -> Iterator[tuple[str, str]]:
    law = calibration.law
    sigma = [math.sqrt(calibration.covariance[i][i]) for i in range(4)]
    curve = "" if law.name == "three_parameter" else f" {law.r_curve:+.4f} (log10 C)^2"
    yield (
        "law",
        (f"log10 I = {law.r_resp:.4f} log10 C{curve} {law.r_expo:+.4f} log10 (T/s) {law.r_const:+.4f} ({law.name})"),
    )
    values = zip(("r_resp", "r_expo", "r_const", "r_curve"), sigma, strict=True)
    yield "uncertainties", ", ".join(f"{name} {doubt:.4f}" for name, doubt in values if doubt > 0.0)
    yield "unit of I", calibration.intensity_unit
    low, high = calibration.usable_response_share
    shortest_s, longest_s = calibration.usable_exposure_s
    yield "usable", f"responses of {low:.2%} to {high:.0%} of full scale"
    yield "", f"exposures of {shortest_s:g} to {longest_s:g} s"
    yield "saturated from", f"{calibration.saturation_share:.1%} of full scale"
    yield "residuals", f"{calibration.residual_rms_share:.2%} rms of the intensity"


def _geometry(calibration: GeometryCalibration) -> Iterator[tuple[str, str]]:
    yield (
        "plate scale",
        (
            f"{calibration.plate_scale_mdeg_per_px:.5f} +- {calibration.plate_scale_uncertainty_mdeg_per_px:.5f} "
            "mdeg per px"
        ),
    )
    if calibration.rotation_deg is None:
        yield "rotation", "not told by this method: the config's stays"
    else:
        doubt = calibration.rotation_uncertainty_deg
        yield "rotation", f"{calibration.rotation_deg:.4f}" + ("" if doubt is None else f" +- {doubt:.4f}") + " deg"
    mirrored = {None: "not told by this method: the config's stays", True: "yes", False: "no"}
    yield "mirrored", mirrored[calibration.mirrored]
    bend = calibration.distortion
    if bend is None:
        yield "distortion", "none"
    else:
        yield "distortion", f"k1 = {bend.k1_per_rad2:.4f} per rad2, k2 = {bend.k2_per_rad4:.3f} per rad4"
        centre = f"column {bend.centre_px[0]:.0f}, row {bend.centre_px[1]:.0f}"
        yield "", f"about {centre}; at the farthest corner {_bend_at_corner(calibration):+.2f} px"
    yield "residuals", f"{calibration.residual_rms_px:.3f} px rms of {calibration.n_points} points"
    yield "method", calibration.method


def _bend_at_corner(calibration: GeometryCalibration) -> float:
    """By how many pixels distortion moves the corner that is farthest from its centre, outwards positive."""
    bend = calibration.distortion
    assert bend is not None
    x, y = (max(centre, size - centre) for centre, size in zip(bend.centre_px, _size(calibration), strict=True))
    radius_px = math.hypot(x, y)
    angle2 = (mdeg_to_rad(calibration.plate_scale_mdeg_per_px) * radius_px) ** 2
    return -radius_px * angle2 * (bend.k1_per_rad2 + angle2 * bend.k2_per_rad4)


def _size(calibration: GeometryCalibration) -> tuple[int, int]:
    return calibration.columns, calibration.rows
