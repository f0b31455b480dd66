"""The newest pair of frames as pictures for whoever watches a recording: smaller, brightened, and soon replaced.

They lie in the run's folder `live`, apart from the frames that are kept: the database knows nothing of them, so nobody
takes them for frames of records. A picture is whole or absent; only the last one of each camera stays.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.store.frames import REFLECTOR_CAMERA, STAR_CAMERA

LIVE_FOLDER: Final = "live"
CAMERAS: Final = (STAR_CAMERA, REFLECTOR_CAMERA)
MAX_COLUMNS: Final = 960
_QUALITY: Final = 75
_BRIGHTENED: Final = np.rint(255.0 * (np.arange(256) / 255.0) ** 0.5).astype(np.uint8)
_NAME: Final = re.compile(rf"([0-9]{{1,18}})_({'|'.join(CAMERAS)})\.jpg")


def picture_of(frame: NDArray[np.uint8] | NDArray[np.uint16], full_scale_adu: float = 255.0) -> bytes:
    """The square root of a frame as JPEG, at most `MAX_COLUMNS` wide: nearly all of it is night.

    Of shape (rows, columns) or (rows, columns, 3) in OpenCV's channel order. 1.4 ms for 2560 x 1920 (bench_live).
    """
    n_rows, n_columns = frame.shape[:2]
    shrink = min(1.0, MAX_COLUMNS / n_columns)
    size = (round(n_columns * shrink), max(round(n_rows * shrink), 1))
    small: NDArray[np.integer | np.floating] = np.asarray(frame)
    while small.shape[1] >= 2 * size[0]:  # halving by the mean is ten times as fast as any other factor
        half = (small.shape[1] // 2, max(small.shape[0] // 2, 1))
        small = np.asarray(cv2.resize(small, half, interpolation=cv2.INTER_AREA))
    if small.shape[1] > size[0]:
        small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR))
    if small.dtype != np.uint8:
        small = np.clip(small.astype(np.float32) * (255.0 / full_scale_adu), 0.0, 255.0)
    brightened = cv2.LUT(small.astype(np.uint8, copy=False), _BRIGHTENED)
    _, data = cv2.imencode(".jpg", brightened, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()


def put_live_picture(run: Path, record_index: int, camera: str, picture: bytes) -> None:
    """Show a picture in place of the camera's last one.

    Without a word where the disk refuses: it is full, or gone, and records matter more.
    """
    folder = run / LIVE_FOLDER
    temporary = folder / f".{camera}.tmp"
    with suppress(OSError):
        folder.mkdir(exist_ok=True)
        try:
            temporary.write_bytes(picture)
            shown = temporary.replace(folder / f"{record_index:06d}_{camera}.jpg")
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
        for name, _ in _found(run, camera):
            if name != shown.name:
                (folder / name).unlink(missing_ok=True)


def live_pictures(run: Path) -> dict[str, int]:
    """Index of the record that the last picture of each camera shows, by camera's name, where there is one."""
    newest = {camera: max((index for _, index in _found(run, camera)), default=None) for camera in CAMERAS}
    return {camera: index for camera, index in newest.items() if index is not None}


def live_picture(run: Path, record_index: int, camera: str) -> bytes | None:
    """That picture as JPEG, None when it is not there or was replaced meanwhile."""
    for name, index in _found(run, camera):
        if index == record_index:
            with suppress(OSError):
                return (run / LIVE_FOLDER / name).read_bytes()
    return None


def _found(run: Path, camera: str) -> list[tuple[str, int]]:
    """Name and record index of the pictures of a camera."""
    try:
        names = [entry.name for entry in (run / LIVE_FOLDER).iterdir()]
    except OSError:
        return []
    matches = [match for name in names if (match := _NAME.fullmatch(name)) and match[2] == camera]
    return [(match[0], int(match[1])) for match in matches]
