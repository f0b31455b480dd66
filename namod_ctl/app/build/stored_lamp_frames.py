"""Frames of a lamp series or of darkness in a folder: which there are, and one at a time their pixels."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.lamp_series import Placement, at_distance, at_level
from namod_ctl.core.errors import CommunicationError, ConfigError, DataQualityError
from namod_ctl.core.units import ms_to_s, us_to_s
from namod_ctl.devices.cameras.frame_files import (
    FITS_ENDINGS,
    PICTURE_ENDINGS,
    SIDE_ENDINGS,
    UnfinishedFileError,
    read_frame_file,
)
from namod_ctl.store.table_text import read_text

Image = NDArray[np.unsignedinteger[Any]]
ExposureUnit = Literal["s", "ms", "us"]

SERIES_FILE = "series.csv"
COLUMNS = ("file", "exposure_s", "level", "distance_m", "is_dark")
EXAMPLE = "file,exposure_s,distance_m,is_dark\nlamp_001.png,0.02,1.5,0\ndark_001.png,0.02,,1"
_TRUE, _FALSE = ("1", "true", "yes"), ("0", "false", "no", "")
_SAME_EXPOSURE = 0.01
_MAX_PROBLEMS = 8


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """One file; `placement` is None for darks, `exposure_s` None where only the file itself tells it."""

    path: Path
    exposure_s: float | None
    placement: Placement | None


@dataclass(frozen=True, slots=True, eq=False)
class ReadFrame:
    """Pixels, exposure in s, and when the exposure began (s since 1970; NaN where nobody knows)."""

    image: Image
    exposure_s: float
    start_s: float


def frames_of_folder(folder: Path) -> list[StoredFrame]:
    """The frames that `series.csv` in the folder names, in its order.

    Raises
    ------
    ConfigError
        There is no such folder or file, or lines of it are wrong: all of these together.
    """
    path = folder / SERIES_FILE
    _require_frames(folder)
    if not path.is_file():
        raise ConfigError(
            f"{path}: is missing; it says of each frame its exposure and the lamp's distance or level, such "
            f"as\n{EXAMPLE}"
        )
    reader = csv.DictReader(io.StringIO(read_text(path)), skipinitialspace=True)
    names = reader.fieldnames or ()
    unknown = [name for name in names if name not in COLUMNS]
    if "file" not in names or unknown or ("level" in names) == ("distance_m" in names):
        raise ConfigError(
            f"{path}: its first line names the columns {', '.join(names) or 'of nothing'}; it must name file, "
            f"exposure_s, either level or distance_m, and is_dark, such as\n{EXAMPLE}"
        )
    frames, problems = [], []
    for row in reader:
        try:
            frames.append(_frame_of_row(folder, row))
        except ValueError as error:
            problems.append(f"{path}, line {reader.line_num}: {error}")
    if problems:
        raise ConfigError("\n".join(problems[:_MAX_PROBLEMS]))
    if not frames:
        raise ConfigError(f"{path}: names no frames; write one line for each, such as\n{EXAMPLE}")
    return frames


def dark_frames_of_folder(folder: Path) -> list[StoredFrame]:
    """The dark frames of a folder: those that its `series.csv` calls dark, else all of its frames."""
    paths = _require_frames(folder)
    if (folder / SERIES_FILE).is_file():
        darks = [frame for frame in frames_of_folder(folder) if frame.placement is None]
        if not darks:
            raise ConfigError(f"{folder / SERIES_FILE}: calls no frame dark (is_dark = 1)")
        return darks
    return [StoredFrame(path, None, None) for path in paths]


def _require_frames(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ConfigError(f"{folder}: this folder does not exist; name one with frames")
    endings = FITS_ENDINGS | PICTURE_ENDINGS
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in endings)
    if not paths:
        raise ConfigError(f"{folder}: holds no frames ({', '.join(sorted(endings))})")
    return paths


def _frame_of_row(folder: Path, row: dict[str, str | None]) -> StoredFrame:
    name = (row.get("file") or "").strip()
    path = folder / name
    if not name or not path.is_file():
        raise ValueError(f"file = {name!r}: there is no such file in {folder}")
    dark = (row.get("is_dark") or "").strip().lower()
    if dark not in _TRUE + _FALSE:
        raise ValueError(f"is_dark = {dark!r}: write 1 or 0")
    text = (row.get("exposure_s") or "").strip()
    exposure_s = _positive(text, "exposure_s") if text else None
    if dark in _TRUE:
        return StoredFrame(path, exposure_s, None)
    if row.get("distance_m") is not None:
        distance_m = _positive(row["distance_m"] or "", "distance_m")
        return StoredFrame(path, exposure_s, at_distance(distance_m))
    return StoredFrame(path, exposure_s, at_level(_positive(row.get("level") or "", "level")))


def _positive(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ValueError(f"{name} = {text.strip()!r}: write a positive number")
    return value


def in_seconds(exposure: float, unit: ExposureUnit) -> float:
    """The exposure of a file, in s, whatever its unit is said to be."""
    if unit == "ms":
        return ms_to_s(exposure)
    return us_to_s(exposure) if unit == "us" else exposure


def read_stored(frame: StoredFrame, unit: ExposureUnit) -> ReadFrame:
    """The pixels of a file, with its exposure.

    Raises
    ------
    DataQualityError
        It cannot be read, tells no exposure, or another than `series.csv`.
    """
    path = frame.path
    has_facts = path.suffix.lower() in FITS_ENDINGS or any(path.with_suffix(end).is_file() for end in SIDE_ENDINGS)
    if not has_facts:
        if frame.exposure_s is None:
            raise DataQualityError(
                f"{path}: nothing tells its exposure; write it into {SERIES_FILE} (column exposure_s) or into "
                f"{path.with_suffix('.json').name}"
            )
        return ReadFrame(_picture(path), in_seconds(frame.exposure_s, unit), math.nan)
    try:
        file = read_frame_file(path)
    except (UnfinishedFileError, CommunicationError) as error:
        raise DataQualityError(f"{path}: cannot be used: {error}") from None
    if frame.exposure_s is not None and not math.isclose(frame.exposure_s, file.exposure_s, rel_tol=_SAME_EXPOSURE):
        raise DataQualityError(
            f"{path}: its exposure is {file.exposure_s:g} by the file itself, but {frame.exposure_s:g} s by "
            f"{SERIES_FILE}: one of them is wrong or in another unit; correct it, or leave the column exposure_s empty"
        )
    start_s = file.start.timestamp() if file.start is not None else math.nan
    return ReadFrame(file.image, in_seconds(file.exposure_s, unit), start_s)


def _picture(path: Path) -> Image:
    image: Any = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    is_frame = image is not None and image.dtype in (np.uint8, np.uint16)
    if not is_frame or image.shape[2:] not in ((), (3,)):
        raise DataQualityError(f"{path}: is no grey or three-colour picture of 8 or 16 bit; save it as PNG or TIFF")
    frame: Image = image
    return frame


def check_kind(frame: StoredFrame, image: Image, columns: int, rows: int, full_scale_adu: float) -> None:
    """Raise DataQualityError for a frame that is not of the config's camera."""
    if image.shape[:2] != (rows, columns):
        raise DataQualityError(
            f"{frame.path}: has {image.shape[1]} x {image.shape[0]} pixel, the camera of the config {columns} x "
            f"{rows}: it is of another camera or mode; take it out, or name the right camera or --config"
        )
    brightest = int(image.max())
    if brightest > full_scale_adu:
        raise DataQualityError(
            f"{frame.path}: has a pixel of {brightest}, but full_scale_adu of the camera is {full_scale_adu:g}: the "
            "frames are of another mode, or the config is wrong"
        )


def numbered_placements(frames: Sequence[StoredFrame]) -> tuple[list[Placement], list[int]]:
    """Stands of the lamp in the order of the frames (of the lamp, not of darkness), and each frame's stand.

    The same distance again after another one is a stand of its own: nobody puts a lamp back exactly.
    """
    placements: list[Placement] = []
    numbers: list[int] = []
    for placement in _placements(frames):
        if not placements or placements[-1] != placement:
            placements.append(placement)
        numbers.append(len(placements) - 1)
    return placements, numbers


def _placements(frames: Sequence[StoredFrame]) -> Iterator[Placement]:
    return (frame.placement for frame in frames if frame.placement is not None)
