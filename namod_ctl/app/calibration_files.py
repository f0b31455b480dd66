"""Calibrations as files: what `namod-ctl calibrate` writes."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

from namod_ctl import __version__
from namod_ctl.app.config.calibration_schema import Calibration, CameraRole
from namod_ctl.app.config.calibrations import TWIN_NUMBER, calibration_to_json
from namod_ctl.app.config.camera_schema import DeviceCameraSection
from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError
from namod_ctl.store.frames import write_file_durably

DEFAULT_VALID_DAYS = 365.0
MAX_VALID_DAYS = 3650.0


def new_header(
    camera: DeviceCameraSection,
    role: CameraRole,
    clock: Clock,
    *,
    source: str,
    verdict: Literal["good", "limited"] = "good",
    remarks: tuple[str, ...] = (),
    valid_days: float = DEFAULT_VALID_DAYS,
    twin_seed: int | None = None,
) -> dict[str, Any]:
    """The head of a calibration of that camera, for the constructor of a section of `calibration_schema`.

    Parameters
    ----------
    source
        What it was made of, in words: which frames, how many, of when.
    twin_seed
        Of the twin that was calibrated instead of the camera: its calibration passes for no real one.

    Raises
    ------
    ConfigError
        `valid_days` is no sensible time.
    """
    check_valid_days(valid_days)
    now = clock.now()
    return {
        "camera": role,
        "model": camera.model,
        "serial_number": camera.serial_number if twin_seed is None else f"{TWIN_NUMBER}{twin_seed}",
        "columns": camera.columns,
        "rows": camera.rows,
        "made_utc": now.isoformat(timespec="seconds"),
        "valid_until_utc": (now + timedelta(days=valid_days)).isoformat(timespec="seconds"),
        "program_version": __version__,
        "source": source,
        "verdict": verdict,
        "remarks": remarks,
    }


def check_valid_days(valid_days: float) -> None:
    """Raise ConfigError for what is no sensible time; call it before hours of measuring."""
    if not 0.0 < valid_days <= MAX_VALID_DAYS:
        raise ConfigError(f"--valid-days {valid_days:g}: must be more than 0 and at most {MAX_VALID_DAYS:g} days")


def check_calibration_output(path: Path, *, force: bool) -> None:
    """Nothing when a calibration may be written to `path`; call it before hours of measuring.

    Raises
    ------
    ConfigError
        It is a folder, exists (without `force`), or its folder does not exist.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; name the file of the calibration")
    if path.exists() and not force:
        raise ConfigError(f"{path}: the file exists; choose another name, or replace it with --force")
    if not path.resolve().parent.is_dir():
        raise ConfigError(f"{path.resolve().parent}: this folder does not exist; make it first")


def write_calibration(path: Path, calibration: Calibration, *, force: bool = False) -> None:
    """Write a calibration file, whole or not at all. Raises ConfigError as `check_calibration_output` does."""
    check_calibration_output(path, force=force)
    write_file_durably(path, calibration_to_json(calibration).encode())


def how_to_use(path: Path, calibration: Calibration) -> str:
    """What the person does next with a new calibration file."""
    text = f'To use it, add to [{calibration.camera}] of the config:  calibrations = ["{path}"]'
    if calibration.serial_number is not None and calibration.serial_number.startswith(TWIN_NUMBER):
        text += "\nIt is of the twin, so it passes for no real camera; to rehearse with it, add there as well:"
        text += '  accept_calibrations = ["foreign"]'
    return text
