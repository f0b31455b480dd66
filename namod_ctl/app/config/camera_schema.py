"""What a config may say about any camera, and about the device behind it: `[star_camera.device]` and the like."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from namod_ctl.app.config.calibration_schema import Calibration
from namod_ctl.app.config.section import FileName, Name, Section, within

DriverName = Literal["pylon", "genicam", "ueye", "alpaca", "indi", "opencv", "folder"]

KEYS_OF_DRIVER = {
    "pylon": ("pixel_format", "gain", "offset_px", "binning", "fed_by_twin"),
    "genicam": ("address", "pixel_format", "gain", "offset_px", "binning"),
    "ueye": ("pixel_format", "gain", "offset_px", "binning"),
    "alpaca": ("address", "device", "gain", "offset_px", "binning"),
    "indi": ("address", "device", "gain", "offset_px", "binning"),
    "opencv": ("address", "pixel_format", "gain", "exposure_range_s"),
    "folder": ("address", "pixel_format", "exposure_range_s"),
}
"""Besides `driver`; what a driver cannot do is no key of it."""

NEEDED_KEYS = {"alpaca": ("address",), "indi": ("address",), "folder": ("address",)}

ExposureS = Annotated[float, within(1e-6, 3600.0)]
PixelOffset = Annotated[int, within(0, 20_000)]


class DeviceSection(Section):
    """The device behind a camera, and how it is set; `serial_number` stands with the camera.

    `fed_by_twin`: an emulated camera of the driver is shown what the twin's camera would see.
    """

    driver: DriverName
    address: FileName | None = None
    device: Name | None = None
    pixel_format: Name | None = None
    gain: Annotated[float, within(-100.0, 100_000.0)] | None = None
    offset_px: Annotated[tuple[PixelOffset, PixelOffset] | None, Field(strict=False)] = None
    binning: Annotated[int, within(1, 16)] | None = None
    exposure_range_s: Annotated[tuple[ExposureS, ExposureS] | None, Field(strict=False)] = None
    fed_by_twin: bool | None = None

    @model_validator(mode="after")
    def _suits_its_driver(self) -> DeviceSection:
        known = KEYS_OF_DRIVER[self.driver]
        for key in DeviceSection.model_fields:
            if key != "driver" and getattr(self, key) is not None and key not in known:
                raise ValueError(f'{key} is no key of driver = "{self.driver}", which knows {", ".join(known)}')
        for key in NEEDED_KEYS.get(self.driver, ()):
            if getattr(self, key) is None:
                raise ValueError(f'driver = "{self.driver}" needs the key {key}; add it')
        if self.exposure_range_s is not None and self.exposure_range_s[0] > self.exposure_range_s[1]:
            raise ValueError("exposure_range_s must be the shortest and the longest exposure in s, in this order")
        return self


class RadiometricLawSection(Section):
    """log10(I) = r_resp log10(C) + r_expo log10(T in s) + r_const, C the response as a share of full scale."""

    r_resp: Annotated[float, within(0.2, 5.0)]
    r_expo: Annotated[float, within(-3.0, -0.2)]
    r_const: Annotated[float, within(-10.0, 10.0)]


AcceptedCalibration = Literal["expired", "foreign"]


class DeviceCameraSection(Section):
    """What any camera has.

    `calibrations` are files, or written out; what they hold takes the place of what stands here.
    `accept_calibrations` lets those pass that are expired, or foreign: of another camera by their serial number.
    """

    model: Name
    serial_number: Name | None = None
    columns: Annotated[int, within(64, 20_000)]
    rows: Annotated[int, within(64, 20_000)]
    full_scale_adu: Annotated[float, within(1.0, 65_535.0)]
    saturation_share: Annotated[float, within(0.5, 1.0)]
    device: DeviceSection | None = None
    calibrations: Annotated[tuple[FileName | Calibration, ...] | None, Field(strict=False)] = None
    accept_calibrations: Annotated[tuple[AcceptedCalibration, ...] | None, Field(strict=False)] = None
