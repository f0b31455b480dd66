"""Calibrations of a camera of a config: read, judged against the camera, and laid over what the config says."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from namod_ctl.app.config.calibration_schema import (
    SCHEMA,
    AxisCalibration,
    Calibration,
    CameraRole,
    DarkCalibration,
    GeometryCalibration,
    RadiometricCalibration,
)
from namod_ctl.app.config.camera_schema import DeviceCameraSection
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, mdeg_to_rad
from namod_ctl.optics.camera_model import CameraModel, DarkModel, Distortion, RadiometricLaw
from namod_ctl.store.table_text import read_text

CameraSection = TypeVar("CameraSection", bound=DeviceCameraSection)

_ADAPTER: TypeAdapter[Calibration] = TypeAdapter(Calibration)
_MAX_PROBLEMS = 8
TWIN_NUMBER = "twin, seed "
"""How the serial numbers of twins begin: they pass for no other camera."""


def calibration_to_json(calibration: Calibration) -> str:
    """Text of a calibration file."""
    return json.dumps({"schema": SCHEMA, **calibration.model_dump(mode="json")}, indent=1, allow_nan=False) + "\n"


def read_calibration(path: Path) -> Calibration:
    """The calibration of a file.

    Raises
    ------
    ConfigError
        There is none, or it is not a calibration file of this program; with file, key, value and rule.
    """
    remedy = "name a file that 'namod-ctl calibrate' wrote"
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; {remedy}")
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such calibration file; {remedy}")
    try:
        raw = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error}); {remedy}") from None
    if not isinstance(raw, dict) or raw.pop("schema", None) != SCHEMA:
        raise ConfigError(f'{path}: is no calibration file: its key "schema" must be "{SCHEMA}"; {remedy}')
    try:
        return _ADAPTER.validate_python(raw)
    except ValidationError as error:
        problems = [
            f"{path}: {'.'.join(map(str, detail['loc'][1:] or detail['loc'])) or 'kind'}: {detail['msg']}"
            + ("" if detail["type"] == "missing" else f" (value: {str(detail['input'])[:60]})")
            for detail in error.errors()[:_MAX_PROBLEMS]
        ]
        raise ConfigError("\n".join(problems)) from None


def with_calibrations_read(camera: CameraSection, folder: Path) -> CameraSection:
    """The section with its calibration files, which lie in `folder` unless their names say else, written out.

    Raises
    ------
    ConfigError
        All that cannot be read.
    """
    read, problems = [], []
    for named in camera.calibrations or ():
        try:
            read.append(read_calibration(folder / Path(named).expanduser()) if isinstance(named, str) else named)
        except ConfigError as problem:
            problems.append(str(problem))
    if problems:
        raise ConfigError("\n".join(problems))
    return camera.model_copy(update={"calibrations": tuple(read)}) if read else camera


def calibrations_of(camera: DeviceCameraSection) -> tuple[Calibration, ...]:
    """The camera's calibrations, of a config whose files are written out."""
    return tuple(calibration for calibration in camera.calibrations or () if not isinstance(calibration, str))


def calibration_problems(camera: DeviceCameraSection, role: CameraRole, moment: datetime | None) -> Iterator[str]:
    """What stands against the camera's calibrations, one text each; without a `moment` their validity is not judged."""
    accepted = camera.accept_calibrations or ()
    kinds = [calibration.kind for calibration in calibrations_of(camera)]
    for kind in sorted({kind for kind in kinds if kinds.count(kind) > 1}):
        yield f"{kinds.count(kind)} calibrations are of the kind {kind}; name the one that is to hold"
    for calibration in calibrations_of(camera):
        what = f"the {calibration.kind} calibration of {calibration.made_utc}"
        if calibration.camera != role:
            yield f"{what} is of the {calibration.camera}; name it there"
        if (calibration.columns, calibration.rows) != (camera.columns, camera.rows):
            yield (
                f"{what} is of images of {calibration.columns} x {calibration.rows} px, the camera's have "
                f"{camera.columns} x {camera.rows}; calibrate anew in this mode"
            )
        if "foreign" not in accepted and _is_foreign(calibration, camera):
            yield (
                f"{what} is foreign: of {_identity(calibration.model, calibration.serial_number)}, but this camera is "
                f"{_identity(camera.model, camera.serial_number)}; calibrate this camera, or let it pass with "
                f'accept_calibrations = ["foreign"]{_beside(accepted)}'
            )
        valid_until = datetime.fromisoformat(calibration.valid_until_utc)
        if "expired" not in accepted and moment is not None and moment > valid_until:
            yield (
                f"{what} has expired on {calibration.valid_until_utc}; calibrate anew, or let it pass with "
                f'accept_calibrations = ["expired"]{_beside(accepted)}'
            )


def _beside(accepted: Sequence[str]) -> str:
    return f" beside {', '.join(accepted)}" if accepted else ""


def _is_foreign(calibration: Calibration, camera: DeviceCameraSection) -> bool:
    numbers = {calibration.serial_number, camera.serial_number}
    if None in numbers and not any(number is not None and number.startswith(TWIN_NUMBER) for number in numbers):
        return calibration.model != camera.model  # all that can tell
    return len(numbers) > 1


def _identity(model: str, serial_number: str | None) -> str:
    return f"{model}, serial number {serial_number or 'not known'}"


def calibrated(camera: CameraModel, calibrations: Sequence[Calibration]) -> CameraModel:
    """The camera with what its calibrations say in place of what its config says."""
    for calibration in calibrations:
        match calibration:
            case RadiometricCalibration():
                law = calibration.law
                camera = replace(
                    camera,
                    law=RadiometricLaw(law.r_resp, law.r_expo, law.r_const, law.r_curve),
                    saturation_share=calibration.saturation_share,
                )
            case DarkCalibration():
                hot = np.array([pixel[:2] for pixel in calibration.hot_pixels], dtype=np.int64).reshape(-1, 2)
                camera = replace(camera, dark=DarkModel(calibration.bias_adu, calibration.rate_adu_per_s, hot))
            case GeometryCalibration():
                camera = _with_geometry(camera, calibration)
            case AxisCalibration():
                camera = replace(camera, axis_pixel=np.array(calibration.axis_px), axis_is_calibrated=True)
    return camera


def _with_geometry(camera: CameraModel, geometry: GeometryCalibration) -> CameraModel:
    orientation = camera.orientation
    if geometry.rotation_deg is not None:
        orientation = replace(orientation, rotation_rad=deg_to_rad(geometry.rotation_deg))
    if geometry.mirrored is not None:
        orientation = replace(orientation, is_mirrored=geometry.mirrored)
    bend = geometry.distortion
    return replace(
        camera,
        plate_scale_rad=mdeg_to_rad(geometry.plate_scale_mdeg_per_px),
        orientation=orientation,
        distortion=None if bend is None else Distortion(np.array(bend.centre_px), bend.k1_per_rad2, bend.k2_per_rad4),
    )
