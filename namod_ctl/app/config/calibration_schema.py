"""What a calibration file holds: one JSON file per calibration of one camera, schema "namod-calibration/1".

A config names the files in `calibrations = [...]` of a camera; `calibrations` lays them over what the config says.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from namod_ctl.app.config.section import Name, Section, within
from namod_ctl.core.units import mdeg_to_rad

SCHEMA = "namod-calibration/1"
CameraRole = Literal["star_camera", "reflector_camera", "psf_camera"]

Text = Annotated[str, Field(max_length=2000)]
Positive = Annotated[float, Field(ge=0.0)]
ImagePixel = Annotated[float, within(-1.0, 20_000.0)]
ImagePoint = Annotated[tuple[ImagePixel, ImagePixel], Field(strict=False)]


def _checked_moment(text: str) -> str:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise ValueError("must be a date with time and time zone, such as 2026-11-22T21:00:00+00:00")
    return text


Moment = Annotated[str, AfterValidator(_checked_moment)]
"""ISO 8601 with a time zone."""


class _Calibration(Section):
    """The head of every calibration.

    `verdict` is "limited" where `remarks` say what it is not good for; a bad calibration is no file.
    """

    camera: CameraRole
    model: Name
    serial_number: Name | None = None
    columns: Annotated[int, within(16, 20_000)]
    rows: Annotated[int, within(16, 20_000)]
    made_utc: Moment
    valid_until_utc: Moment
    program_version: Name
    source: Text
    verdict: Literal["good", "limited"]
    remarks: Annotated[tuple[Text, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _is_valid_for_some_time(self) -> _Calibration:
        if datetime.fromisoformat(self.valid_until_utc) <= datetime.fromisoformat(self.made_utc):
            raise ValueError("valid_until_utc must be later than made_utc")
        return self


class LawSection(Section):
    """log10 I = r_resp x + r_curve x^2 + r_expo log10(T in s) + r_const, x = log10 of the share of full scale."""

    name: Literal["three_parameter", "curved"]
    r_resp: Annotated[float, within(0.2, 5.0)]
    r_expo: Annotated[float, within(-3.0, -0.2)]
    r_const: Annotated[float, within(-10.0, 10.0)]
    r_curve: Annotated[float, within(-2.0, 2.0)] = 0.0

    @model_validator(mode="after")
    def _is_what_it_is_called(self) -> LawSection:
        if self.name == "three_parameter" and self.r_curve != 0.0:
            raise ValueError('r_curve must be 0 in the law "three_parameter"')
        return self


Row4 = Annotated[tuple[float, float, float, float], Field(strict=False)]
Row2 = Annotated[tuple[float, float], Field(strict=False)]
Range = Annotated[tuple[Positive, Positive], Field(strict=False)]


class RadiometricCalibration(_Calibration):
    """Response of the camera to light; `covariance` in the order r_resp, r_expo, r_const, r_curve, 0 what is fixed."""

    kind: Literal["radiometric"]
    law: LawSection
    covariance: Annotated[tuple[Row4, Row4, Row4, Row4], Field(strict=False)]
    intensity_unit: Text
    saturation_share: Annotated[float, within(0.5, 1.0)]
    usable_response_share: Range
    usable_exposure_s: Range
    residual_rms_share: Positive


HotPixel = Annotated[
    tuple[Annotated[int, within(0, 20_000)], Annotated[int, within(0, 20_000)], float, float], Field(strict=False)
]


class DarkCalibration(_Calibration):
    """What the camera shows without light: bias + rate T, and pixels (x, y, offset, rate) with more of their own."""

    kind: Literal["dark"]
    bias_adu: Annotated[float, within(-100.0, 65_535.0)]
    rate_adu_per_s: Annotated[float, within(-1e5, 1e5)]
    read_noise_adu: Positive
    fixed_pattern_adu: Positive
    hot_pixels: Annotated[tuple[HotPixel, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _pixels_are_in_image(self) -> DarkCalibration:
        for x, y, _, _ in self.hot_pixels:
            if x >= self.columns or y >= self.rows:
                raise ValueError(f"hot pixel ({x}, {y}) lies outside the {self.columns} x {self.rows} image")
        return self


class DistortionSection(Section):
    """Offset v from `centre_px` is as v (1 + k1 a^2 + k2 a^4) without distortion, a = plate scale x length of v."""

    centre_px: ImagePoint
    k1_per_rad2: Annotated[float, within(-50.0, 50.0)]
    k2_per_rad4: Annotated[float, within(-1e4, 1e4)] = 0.0


class GeometryCalibration(_Calibration):
    """Directions of pixels; null is what its method cannot tell: there the config's value stays."""

    kind: Literal["geometry"]
    plate_scale_mdeg_per_px: Annotated[float, within(0.05, 500.0)]
    plate_scale_uncertainty_mdeg_per_px: Positive
    rotation_deg: Annotated[float, within(-360.0, 360.0)] | None = None
    rotation_uncertainty_deg: Positive | None = None
    mirrored: bool | None = None
    distortion: DistortionSection | None = None
    residual_rms_px: Positive
    method: Name
    n_points: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _has_one_direction_per_pixel(self) -> GeometryCalibration:
        bend = self.distortion
        if bend is None:
            return self
        x, y = (max(at, size - at) for at, size in zip(bend.centre_px, (self.columns, self.rows), strict=True))
        angle2 = (mdeg_to_rad(self.plate_scale_mdeg_per_px) ** 2) * (x**2 + y**2)
        if min(1.0 + a2 * (3.0 * bend.k1_per_rad2 + 5.0 * bend.k2_per_rad4 * a2) for a2 in (angle2, angle2 / 2.0)) <= 0:
            raise ValueError("distortion folds the image onto itself before its corner: k1 and k2 cannot be right")
        return self


ZenithRow = Annotated[tuple[Annotated[float, within(0.0, 90.0)], float, float], Field(strict=False)]


class AxisCalibration(_Calibration):
    """Where the telescope's optical axis lies in the star camera; `over_zenith` rows are (zenith_deg, x_px, y_px)."""

    kind: Literal["axis"]
    axis_px: ImagePoint
    covariance_px2: Annotated[tuple[Row2, Row2], Field(strict=False)]
    method: Name
    over_zenith: Annotated[tuple[ZenithRow, ...], Field(strict=False)] = ()


Calibration = Annotated[
    RadiometricCalibration | DarkCalibration | GeometryCalibration | AxisCalibration, Field(discriminator="kind")
]
