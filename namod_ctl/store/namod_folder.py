"""What lies in a folder of the original NAMOD program: its records' files, its map of the facets, its calibrations.

For record n the files share a prefix P = `<stamp>_sccan_<n>`: `P.cfg`, and per camera `P_star.png`, `P_star.info`
(exposure), `P_star.int` (calibration), likewise `P_reflector.*`. `reflector.cfg` maps the facets. The star's place
in `P.cfg` is not used, it is that of a simple detector; nor are the images' names, which follow from the prefix.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, ms_to_s
from namod_ctl.optics.camera_model import RadiometricLaw
from namod_ctl.store.frames import png_size
from namod_ctl.store.libconfig import Group, read_libconfig

CAMERAS = ("star", "reflector")
_MEMBER = re.compile(r"(?P<stamp>.*)_sccan_(?P<number>\d+)(?:\.cfg|_(?:star|reflector)\.(?:png|info|int))", re.ASCII)


@dataclass(frozen=True, slots=True)
class RecordFiles:
    """Where the files of one record are, or should be."""

    folder: Path
    prefix: str

    @property
    def config(self) -> Path:
        """`P.cfg`: that the record was completed."""
        return self.folder / f"{self.prefix}.cfg"

    def image(self, camera: str) -> Path:
        """The frame of the "star" or "reflector" camera."""
        return self.folder / f"{self.prefix}_{camera}.png"

    def exposure(self, camera: str) -> Path:
        """The file with that frame's exposure."""
        return self.folder / f"{self.prefix}_{camera}.info"

    def calibration(self, camera: str) -> Path:
        """The file with that camera's calibration."""
        return self.folder / f"{self.prefix}_{camera}.int"

    def all(self) -> tuple[Path, ...]:
        """Every file the record should have."""
        per_camera = (path(camera) for camera in CAMERAS for path in (self.image, self.exposure, self.calibration))
        return (self.config, *per_camera)


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """A camera as a `.int` file describes it."""

    plate_scale_rad: float
    law: RadiometricLaw


@dataclass(frozen=True, slots=True, eq=False)
class FacetMap:
    """`reflector.cfg`.

    Attributes
    ----------
    tripod_radius_m, pitch_m_per_turn
        Of every facet's mount.
    tripod_orientation_rad
        Turn of each facet's tripod about +z, by facet id.
    polygons_px
        Outline of each facet in the reflector camera's image by facet id, shape (n_corners, 2), (x, y) pixel.
    """

    source: Path
    reflector_name: str
    tripod_radius_m: float
    pitch_m_per_turn: float
    tripod_orientation_rad: dict[int, float]
    polygons_px: dict[int, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class NamodFolder:
    """A folder of the original program.

    Attributes
    ----------
    records
        Ordered by stamp, then by number.
    star_camera, reflector_camera
        Calibrations of the first record that has them; records with others do not count.
    star_size_px, reflector_size_px
        (columns, rows) that most frames have; others do not count.
    """

    path: Path
    records: tuple[RecordFiles, ...]
    facet_map: FacetMap
    star_camera: CameraCalibration
    reflector_camera: CameraCalibration
    star_size_px: tuple[int, int]
    reflector_size_px: tuple[int, int]


def read_namod_folder(folder: Path, config_facet_ids: Sequence[int]) -> NamodFolder:
    """What the folder holds; the records' images are not decoded yet.

    Raises
    ------
    ConfigError
        No folder, no records in it, no `reflector.cfg` or a wrong one, facets that are not in
        `config_facet_ids`, no record with a readable calibration, or no image at all.
    """
    if not folder.is_dir():
        state = "is a file, not a folder" if folder.exists() else "there is no such folder"
        raise ConfigError(f"{folder}: {state}; name the folder of the original program")
    facet_map = read_facet_map(folder / "reflector.cfg")
    unknown = sorted(set(facet_map.polygons_px) - set(config_facet_ids))
    if unknown:
        raise ConfigError(
            f"{facet_map.source}: facets that the config does not know: {unknown}; it has {sorted(config_facet_ids)}; "
            "name the right telescope with --config"
        )
    records = find_records(folder)
    star, reflector = (_first_calibration(folder, records, camera) for camera in CAMERAS)
    star_size, reflector_size = (_usual_size(folder, records, camera) for camera in CAMERAS)
    return NamodFolder(folder, records, facet_map, star, reflector, star_size, reflector_size)


def find_records(folder: Path) -> tuple[RecordFiles, ...]:
    """All records of which at least one file is there, by stamp and number. Raises ConfigError when there are none."""
    found: dict[tuple[str, int, str], RecordFiles] = {}
    for path in folder.iterdir():
        match = _MEMBER.fullmatch(path.name)
        if match is not None:
            prefix = f"{match['stamp']}_sccan_{match['number']}"
            found[match["stamp"], int(match["number"]), prefix] = RecordFiles(folder, prefix)
    if not found:
        raise ConfigError(f"{folder}: there are no records here (files named <stamp>_sccan_<n>.cfg)")
    return tuple(found[key] for key in sorted(found))


def read_facet_map(path: Path) -> FacetMap:
    """The map of the facets in `reflector.cfg`. Raises ConfigError, naming key and facet."""
    try:
        root = read_libconfig(path)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: is missing; it holds the map of the facets and no record counts without") from error
    reflector = root.group("reflector")
    polygons: dict[int, NDArray[np.float64]] = {}
    orientations: dict[int, float] = {}
    for mirror in reflector.groups("mirrors"):
        facet_id = mirror.integer("ID")
        if facet_id in polygons:
            raise ConfigError(f"{mirror.where}: facet {facet_id} appears twice; remove one")
        corners = [(corner.number("x"), corner.number("y")) for corner in mirror.groups("polygon")]
        if len(corners) > 1 and corners[0] == corners[-1]:
            corners.pop()  # a closed outline
        if len(corners) < 3:
            raise ConfigError(
                f"{mirror.where}: the polygon of facet {facet_id} has {len(corners)} corners, at least 3 needed"
            )
        polygons[facet_id] = np.array(corners)
        orientations[facet_id] = deg_to_rad(mirror.number("tripod_orientation_z_in_deg"))
    if not polygons:
        raise ConfigError(f"{reflector.where}: the list of mirrors is empty")
    return FacetMap(
        source=path,
        reflector_name=reflector.text("reflector_name"),
        tripod_radius_m=reflector.positive_number("tripod_radius_in_m"),
        pitch_m_per_turn=reflector.positive_number("pitch_of_bolt_in_m_per_revolution"),
        tripod_orientation_rad=orientations,
        polygons_px=polygons,
    )


def read_calibration(path: Path) -> CameraCalibration:
    """The calibration in a `.int` file. Raises ConfigError, and FileNotFoundError when there is none."""
    group = read_libconfig(path).group("intrinsic_parameter")
    return CameraCalibration(
        plate_scale_rad=deg_to_rad(group.positive_number("pixel2angle")),
        law=RadiometricLaw(
            r_resp=group.number("polynom_coeff_1"),
            r_expo=group.number("polynom_coeff_2"),
            r_const=group.number("polynom_coeff_0"),
        ),
    )


def read_exposure_s(path: Path) -> float:
    """The exposure in a `.info` file. Raises ConfigError, and FileNotFoundError when there is none."""
    return ms_to_s(read_libconfig(path).group("sccan_image").positive_number("exposure_time_in_ms"))


def check_record_config(path: Path) -> Group:
    """The settings of `P.cfg`. Raises ConfigError, and FileNotFoundError when there is none."""
    return read_libconfig(path).group("sccan")


def _first_calibration(folder: Path, records: Sequence[RecordFiles], camera: str) -> CameraCalibration:
    complaint = ""
    for record in records:
        try:
            return read_calibration(record.calibration(camera))
        except FileNotFoundError:
            continue
        except ConfigError as error:
            complaint = complaint or f" (the first complaint: {error})"
    raise ConfigError(
        f"{folder}: no record has a readable calibration of the {camera} camera (P_{camera}.int){complaint}"
    )


def _usual_size(folder: Path, records: Sequence[RecordFiles], camera: str) -> tuple[int, int]:
    sizes = Counter(size for record in records if (size := png_size(record.image(camera))) is not None)
    if not sizes:
        raise ConfigError(f"{folder}: not one image of the {camera} camera is a PNG file (P_{camera}.png)")
    return sizes.most_common(1)[0][0]
