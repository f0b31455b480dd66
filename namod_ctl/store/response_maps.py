"""Response maps of the original program: one CSV file per facet, `mirror_ID<id>_response_map.csv`.

Columns `dir_X [deg],dir_Y [deg],normalized_mirror_response [1]`; row i is the same record in every file.
Reading is strict: a file that is not exactly this is refused with its name and line, for a row that is
guessed or skipped would shift all the rows after it against the other facets.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad

Array = NDArray[np.float64]

HEADER = "dir_X [deg],dir_Y [deg],normalized_mirror_response [1]"
MAX_DIRECTION_DEG = (
    10.0  # beyond the field of view of any star camera (4.34 deg at FACT): not degrees, or no directions
)
_FILE_GLOB = "mirror_ID*_response_map.csv"
_FILE_NAME = re.compile(r"mirror_ID(\d+)_response_map\.csv", re.ASCII)

# the program wrote 6 significant digits of at most some hundred pixels: a true grid is met to a few 1e-4 pixel
_GRID_TOLERANCE_PX = 0.02
_GRID_SEARCH_SHARE = 0.01  # calibrations of a plate scale differ by less than this
_GRID_MIN_RECORDS = 5  # fewer directions can lie on some grid by chance


@dataclass(frozen=True, slots=True, eq=False)
class ResponseMaps:
    """The maps of a folder.

    Attributes
    ----------
    facet_ids
        Facets that have a map, in the order of the config.
    theta_rad
        Shape (n_records, 2). Direction of the star; the files' axes are the telescope frame's x and y.
    response
        Shape (n_records, n_facets). Normalized response R_ij, finite and not negative.
    """

    facet_ids: tuple[int, ...]
    theta_rad: Array
    response: Array


def parse_response_map(text: str, source: str) -> Array:
    """Rows of one map, shape (n_records, 3): direction x and y in deg, response.

    Raises
    ------
    ConfigError
        Naming `source` and line: wrong header, missing columns, a value that is no number, not finite, negative
        or too large for a direction; no record at all; no line break at the end (a cut number reads as another number).
    """
    lines = text.split("\n")
    header = lines[0].strip()
    if header != HEADER:
        raise ConfigError(f"{source}, line 1: the header is {header[:80]!r}, expected is {HEADER!r}")
    if lines[-1]:
        raise ConfigError(
            f"{source}, line {len(lines)}: the file does not end with a line break, so it may be cut off; "
            "copy it again, or add the line break if it is whole"
        )
    rows = [_parse_row(line, f"{source}, line {number}") for number, line in enumerate(lines[1:-1], start=2)]
    if not rows:
        raise ConfigError(f"{source}: there are no records in it, only a header")
    return np.array(rows, dtype=np.float64)


def read_response_maps(folder: Path, config_facet_ids: Sequence[int]) -> ResponseMaps:
    """All maps in `folder`.

    Raises
    ------
    ConfigError
        No folder, no maps, a map that is damaged, belongs to no facet of `config_facet_ids`, or disagrees with
        the others in length or directions.
    """
    files = _find_files(folder, config_facet_ids)
    facet_ids = tuple(facet_id for facet_id in config_facet_ids if facet_id in files)
    first = files[facet_ids[0]]
    first_rows = _read_file(first)
    response = np.empty((len(first_rows), len(facet_ids)))
    for column, facet_id in enumerate(facet_ids):
        file = files[facet_id]
        rows = first_rows if column == 0 else _read_file(file)
        _check_same_records(first, first_rows, file, rows)
        response[:, column] = rows[:, 2]
    return ResponseMaps(facet_ids, deg_to_rad(first_rows[:, :2]), response)


def pixel_grid_step_rad(theta_rad: Array, plate_scale_rad: float) -> float | None:
    """Step of the grid of whole pixels on which all directions lie, None when they lie on none.

    The original program located stars to whole pixels, measured from the image's centre. The step is searched
    for within 1 % of the camera's plate scale, for the calibration of that day need not be today's: the FACT
    maps of May 2014 have 2.4275 mdeg where the paper gives 2.437.

    Parameters
    ----------
    theta_rad
        Shape (n_records, 2).
    """
    if len(theta_rad) < _GRID_MIN_RECORDS or not np.any(theta_rad):
        return None
    largest_px = float(np.max(np.abs(theta_rad))) / plate_scale_rad
    # neighbouring trials differ by a tenth of a pixel at the largest direction
    n_trials = max(3, math.ceil(2 * _GRID_SEARCH_SHARE * largest_px / 0.1))
    trials = plate_scale_rad * np.linspace(1 - _GRID_SEARCH_SHARE, 1 + _GRID_SEARCH_SHARE, n_trials)
    for trial in sorted(trials, key=lambda step: float(_distance_to_grid_px(theta_rad, step))):
        pixel = np.round(theta_rad / trial)
        step = float(np.sum(theta_rad * pixel) / np.sum(pixel**2)) if np.any(pixel) else float(trial)
        if float(np.max(np.abs(theta_rad / step - np.round(theta_rad / step)))) < _GRID_TOLERANCE_PX:
            return step
    return None


def _distance_to_grid_px(theta_rad: Array, step_rad: float) -> float:
    pixel = theta_rad / step_rad
    return float(np.mean(np.abs(pixel - np.round(pixel))))


def _parse_row(line: str, where: str) -> tuple[float, float, float]:
    fields = line.split(",")
    if len(fields) != 3:
        raise ConfigError(f"{where}: {len(fields)} columns instead of 3 in {line[:80]!r}; is the file cut off?")
    x, y, response = (_parse_number(field, where) for field in fields)
    for value in (x, y):
        if abs(value) > MAX_DIRECTION_DEG:
            raise ConfigError(
                f"{where}: direction {value:g} deg lies beyond any star camera (limit {MAX_DIRECTION_DEG:g} deg)"
            )
    if response < 0.0:
        raise ConfigError(f"{where}: the response {response:g} is negative; a response is 0 or more")
    return x, y, response


def _parse_number(field: str, where: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = None
    if value is None or "_" in field:  # Python reads 1_000 as a number
        raise ConfigError(f"{where}: {field.strip()[:40]!r} is not a number")
    if not math.isfinite(value):
        raise ConfigError(f"{where}: the value {field.strip()} is not finite; remove this record from all files")
    return value


def _find_files(folder: Path, config_facet_ids: Sequence[int]) -> dict[int, Path]:
    if not folder.is_dir():
        state = "is a file, not a folder" if folder.exists() else "there is no such folder"
        raise ConfigError(f"{folder}: {state}; name the folder with the response maps")
    files: dict[int, Path] = {}
    for file in sorted(folder.glob(_FILE_GLOB)):
        match = _FILE_NAME.fullmatch(file.name)
        if match is None:
            raise ConfigError(f"{file}: there is no facet id in the name; expected is {_FILE_GLOB} with a number for *")
        facet_id = int(match[1])
        if facet_id in files:
            raise ConfigError(f"{file}: facet {facet_id} has another map already, {files[facet_id].name}; remove one")
        files[facet_id] = file
    if not files:
        raise ConfigError(f"{folder}: there are no response maps here ({_FILE_GLOB})")
    unknown = [facet_id for facet_id in files if facet_id not in set(config_facet_ids)]
    if unknown:
        raise ConfigError(
            f"{folder}: there are maps of facets that the config does not know: {sorted(unknown)}; it has "
            f"{sorted(config_facet_ids)}; name the right telescope with --config or remove the files"
        )
    return files


def _read_file(file: Path) -> Array:
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: is not a text file ({error.reason} at byte {error.start})") from error
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read ({error.strerror})") from error
    return parse_response_map(text, str(file))


def _check_same_records(first: Path, first_rows: Array, file: Path, rows: Array) -> None:
    if len(rows) != len(first_rows):
        raise ConfigError(
            f"{file}: has {len(rows)} records, {first.name} has {len(first_rows)}; "
            "row i must be the same record in every file"
        )
    differs = np.any(rows[:, :2] != first_rows[:, :2], axis=1)
    if np.any(differs):
        row = int(np.argmax(differs))
        here, there = rows[row, :2].tolist(), first_rows[row, :2].tolist()
        raise ConfigError(
            f"{file}, line {row + 2}: the direction {here} deg differs from {there} deg in {first.name}; "
            "row i must be the same record in every file"
        )
