"""From the files of one record to the record: a file that is missing or damaged costs this record and no other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.frames import Frame, decode_png
from namod_ctl.store.namod_folder import (
    CAMERAS,
    CameraCalibration,
    RecordFiles,
    check_record_config,
    read_calibration,
    read_exposure_s,
)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringContext:
    """What all records of an import have in common; can be sent to another process.

    Attributes
    ----------
    instrument
        With the cameras' sizes and calibrations, and a polygon for every facet to be measured.
    facet_ids
        Facets to be measured, in the order of the run.
    star_calibration, reflector_calibration
        What every record's own calibration files must say.
    """

    instrument: Instrument
    facet_ids: tuple[int, ...]
    star_calibration: CameraCalibration
    reflector_calibration: CameraCalibration


class Measurer:
    """Measures records; its facets' pixels are collected once.

    Raises
    ------
    ConfigError
        A facet has no polygon, or one that is outside the image or crosses itself.
    """

    def __init__(self, context: MeasuringContext) -> None:
        camera = context.instrument.reflector_camera
        self._context = context
        self._photometer = FacetPhotometer(
            context.instrument.facet_polygons_px, context.facet_ids, camera.n_columns, camera.n_rows
        )

    def measure(self, index: int, files: RecordFiles) -> Record:
        """The record of these files; rejected, with file and reason in its detail, if one is not as it must be."""
        n_facets = len(self._context.facet_ids)
        try:
            exposures_s, frames = self._read(files)
        except FileNotFoundError as error:
            detail = f"{Path(error.filename).name} is missing"
            return _unreadable_record(index, files.prefix, n_facets, RejectReason.FILE_MISSING, detail)
        except _DamagedFileError as error:
            return _unreadable_record(index, files.prefix, n_facets, RejectReason.FILE_CORRUPT, str(error))
        return measure_record(
            frames["star"],
            frames["reflector"],
            exposures_s["star"],
            exposures_s["reflector"],
            self._context.instrument,
            self._photometer,
            index,
            files.prefix,
        )

    def _read(self, files: RecordFiles) -> tuple[dict[str, float], dict[str, Frame]]:
        """Exposures and frames by camera."""
        instrument = self._context.instrument
        usual = {"star": self._context.star_calibration, "reflector": self._context.reflector_calibration}
        models = {"star": instrument.star_camera, "reflector": instrument.reflector_camera}
        try:
            check_record_config(files.config)
            for camera in CAMERAS:
                if read_calibration(files.calibration(camera)) != usual[camera]:
                    raise _DamagedFileError(
                        f"{files.calibration(camera).name}: the calibration differs from that of the first record"
                    )
            exposures_s = {camera: read_exposure_s(files.exposure(camera)) for camera in CAMERAS}
            frames = {camera: _read_frame(files.image(camera), models[camera]) for camera in CAMERAS}
        except ConfigError as error:
            raise _DamagedFileError(str(error).replace(f"{files.folder}/", "")) from error
        except FileNotFoundError:
            raise
        except OSError as error:
            raise _DamagedFileError(f"{Path(error.filename).name}: cannot be read ({error.strerror})") from error
        return exposures_s, frames


class _DamagedFileError(Exception):
    """A file of a record is there, but cannot be used."""


def _read_frame(path: Path, camera: CameraModel) -> Frame:
    try:
        frame = decode_png(path.read_bytes())
    except ValueError as error:
        raise _DamagedFileError(f"{path.name}: {error}") from error
    if frame.dtype != np.uint8:  # the original program wrote no others: the law of its cameras would not hold
        raise _DamagedFileError(f"{path.name}: the PNG has {8 * frame.dtype.itemsize} bits per channel, 8 are expected")
    n_rows, n_columns = frame.shape[:2]
    if (n_columns, n_rows) != (camera.n_columns, camera.n_rows):
        raise _DamagedFileError(
            f"{path.name}: the image has {n_columns} x {n_rows} pixel, "
            f"most others have {camera.n_columns} x {camera.n_rows}"
        )
    return frame


def _unreadable_record(index: int, label: str, n_facets: int, reason: RejectReason, detail: str) -> Record:
    return Record(
        index=index,
        label=label,
        theta_rad=np.full(2, np.nan),
        theta_uncertainty_rad=math.nan,
        star_intensity=math.nan,
        facet_intensity=np.full(n_facets, np.nan),
        facet_saturated_share=np.full(n_facets, np.nan),
        star_exposure_s=math.nan,
        reflector_exposure_s=math.nan,
        reject_reason=reason,
        detail=detail,
    )
