"""Stored frames of one camera for a calibration: files, folders of files, or runs that have kept their frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.twin_note import noted_twin
from namod_ctl.core.errors import CommunicationError, ConfigError, StoreError
from namod_ctl.devices.cameras.frame_files import (
    FITS_ENDINGS,
    PICTURE_ENDINGS,
    UnfinishedFileError,
    read_frame_file,
)
from namod_ctl.store.folders import is_run
from namod_ctl.store.frames import decode_png, read_verified
from namod_ctl.store.run import RunStore

Image = NDArray[np.unsignedinteger[Any]]

HOW_TO = (
    "give FITS files with EXPTIME and DATE-OBS (to a fraction of a second), PNG or TIFF files with a side file that "
    "tells exposure_s and start_utc, or a run recorded with --keep-frames all"
)


@dataclass(frozen=True, slots=True, eq=False)
class SeriesFrame:
    """One frame.

    Attributes
    ----------
    name
        Its file.
    exposure_s
        NaN where nothing tells it.
    time_s
        Middle of the exposure, on a clock that all frames of its source share; None where nothing tells it.
    utc
        The same moment as time of day; None where it is not known to a second.
    rough_utc
        As `utc`, or within minutes; None where nothing tells it.
    """

    name: str
    image: Image
    exposure_s: float
    time_s: float | None
    utc: datetime | None
    rough_utc: datetime | None


@dataclass(slots=True)
class FrameSeries:
    """Frames of `camera` ("star_camera" or "reflector_camera"), in the order in which their sources are named.

    Attributes
    ----------
    problems
        One text for every frame that cannot be used; grows while frames are read.
    """

    sources: Sequence[Path]
    camera: str
    needs_exposure: bool = True
    problems: list[str] = field(default_factory=list)

    def frames(self) -> Iterator[SeriesFrame]:
        """Every frame that can be read, one after the other.

        Raises
        ------
        ConfigError
            A source does not exist, or holds no frame.
        """
        for source in self.sources:
            if is_run(source):
                yield from self._of_run(source)
            else:
                for path in _files_of(source):
                    frame = self._of_file(path)
                    if frame is not None:
                        yield frame

    def _of_run(self, source: Path) -> Iterator[SeriesFrame]:
        with RunStore.open(source) as run:
            files = run.frame_files(self.camera)
            if not files:
                raise ConfigError(
                    f"{source}: this run has kept no frames of the {self.camera}; record with --keep-frames all"
                )
            records = run.records()
            begun = datetime.fromisoformat(run.created_utc)
        times_s = [record.star_mid_exposure_s for record in records if np.isfinite(record.star_mid_exposure_s)]
        for record in records:
            if record.index not in files:
                continue
            path, sha256 = files[record.index]
            try:
                image = decode_png(read_verified(path, sha256))
            except (StoreError, ValueError) as error:
                self.problems.append(str(error))
                continue
            is_star = self.camera == "star_camera"
            exposure_s = record.star_exposure_s if is_star else record.reflector_exposure_s
            time_s = record.star_mid_exposure_s if is_star else record.reflector_mid_exposure_s
            is_timed = bool(np.isfinite(time_s))
            rough = begun + timedelta(seconds=time_s - min(times_s)) if is_timed and times_s else begun
            yield SeriesFrame(path.name, image, exposure_s, time_s if is_timed else None, None, rough)

    def _of_file(self, path: Path) -> SeriesFrame | None:
        try:
            if not self.needs_exposure and path.suffix.lower() in PICTURE_ENDINGS:
                return SeriesFrame(path.name, _picture(path), float("nan"), None, None, None)
            read = read_frame_file(path)
        except (CommunicationError, UnfinishedFileError, OSError, ValueError) as error:
            text = str(error)
            self.problems.append(text if path.name in text else f"{path}: {text}")
            return None
        if read.start is None:
            return SeriesFrame(path.name, read.image, read.exposure_s, None, None, None)
        middle = read.start + timedelta(seconds=read.exposure_s / 2.0)
        time_s = (middle - datetime(2000, 1, 1, tzinfo=UTC)).total_seconds()
        return SeriesFrame(path.name, read.image, read.exposure_s, time_s, middle, middle)


def twin_of_runs(sources: Sequence[Path]) -> int | None:
    """Seed of the twin of the first source that is a run recorded with one; None when there is none.

    What is calibrated with it is of that twin, and must pass for no real camera.
    """
    for source in sources:
        if is_run(source):
            with RunStore.open(source) as store:
                noted = noted_twin(store)
            if noted is not None:
                return noted[1]
    return None


def _files_of(source: Path) -> list[Path]:
    """The file itself, or those of a folder, by name."""
    known = FITS_ENDINGS | PICTURE_ENDINGS
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in known and path.is_file())
        if not files:
            raise ConfigError(f"{source}: there is no frame in this folder; {HOW_TO}")
        return files
    if not source.exists():
        raise ConfigError(f"{source}: there is no such file or folder; {HOW_TO}")
    if source.suffix.lower() not in known:
        raise ConfigError(f"{source}: is no frame of a known kind ({', '.join(sorted(known))}); {HOW_TO}")
    return [source]


def _picture(path: Path) -> Image:
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("cannot be decoded")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"pixels are {image.dtype}; write unsigned integers of 8 or 16 bit")
    return np.ascontiguousarray(image)
