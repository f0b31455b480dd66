"""What a person works on who makes a map of the facets: a picture, a config, and where the map goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.extends import read_extended
from namod_ctl.app.config.instrument import builtin_folder, find_config, load_config
from namod_ctl.app.sheets.overlay import scale_polygons
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.imaging.facet_edges import EdgePicture, Proposal, propose_from_marks, propose_without_marks
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.camera_pose import (
    MIN_FACETS_FOR_DISTORTION,
    CameraPose,
    outlines_in_image,
    project_facets,
)
from namod_ctl.optics.facet_marks import MarkedPose, pose_of_marks, turn_note
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.polygons import map_faults
from namod_ctl.store.polygon_table import write_polygon_table

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_TURN_RAD = deg_to_rad(10.0)
"""An image that is turned further against the config's rotation_deg is worth a word."""
MAX_UNCERTAINTY_PX = 2.0
"""In an image of 1000 columns: beyond it a map is too coarse to be measured with."""


@dataclass(frozen=True, slots=True, eq=False)
class Workbench:
    """A picture of a reflector and the instrument it is of. All polygons are in the picture's own pixels.

    Attributes
    ----------
    camera
        The reflector camera as if it had the picture's number of pixels.
    out
        Where the map goes; None where the config names no file of its own.
    config_map
        The file in which the config keeps its map, if it is one of the user's own.
    """

    instrument: Instrument
    camera: CameraModel
    image: Image
    image_name: str
    out: Path | None
    config_map: Path | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the picture."""
        return self.camera.n_columns, self.camera.n_rows

    def polygons_px(self) -> dict[int, Array]:
        """The config's present map."""
        model = self.instrument.reflector_camera
        return scale_polygons(self.instrument.facet_polygons_px, (model.n_columns, model.n_rows), self.size)

    def solve(self, marks_px: Mapping[int, Array]) -> MarkedPose:
        """The camera's pose from marked facets. Raises MarksError."""
        return pose_of_marks(marks_px, self.instrument.reflector, self.camera, self.camera.orientation.is_mirrored)

    def propose(self, marks_px: Mapping[int, Array]) -> Proposal:
        """The pose that the picture's edges suggest, near that of marks where there are any. Raises MarksError."""
        reflector = self.instrument.reflector
        picture = EdgePicture(self.image, reflector, self.camera)
        if marks_px:
            return propose_from_marks(picture, reflector, self.solve(marks_px).pose)
        return propose_without_marks(picture, reflector, self.camera)

    def outlines_px(self, pose: CameraPose) -> dict[int, Array]:
        """Outlines of all facets as far as they lie in the picture."""
        return outlines_in_image(project_facets(pose, self.instrument.reflector), *self.size)

    def next_step(self) -> str:
        """What to do with the file that was written."""
        if self.out is None or (self.config_map is not None and self.out.resolve() == self.config_map.resolve()):
            return "The config uses it from now on."
        return f'To use it, put [reflector_map] polygons_file = "{self.out.name}" into your config, beside the file.'

    def faults(self, polygons_px: Mapping[int, Array]) -> dict[int, list[str]]:
        """What forbids to use this map, by facet id."""
        faults = map_faults(polygons_px, *self.size)
        for facet_id in sorted(set(polygons_px) - set(self.instrument.reflector.ids)):
            faults.setdefault(facet_id, []).append("is no facet of this reflector: correct its id")
        return faults

    def missing(self, polygons_px: Mapping[int, Array]) -> list[int]:
        """Facets of the reflector that have no outline."""
        return [facet_id for facet_id in self.instrument.reflector.ids if facet_id not in polygons_px]

    def mark_notes(self, solution: MarkedPose) -> list[str]:
        """What a person should know about a pose that rests on marks alone."""
        notes = []
        if len(solution.residual_px) < MIN_FACETS_FOR_DISTORTION:
            notes.append(
                f"with less than {MIN_FACETS_FOR_DISTORTION} marks the lens is taken to be without distortion; that of "
                "FACT moves facets by up to 30 px: look closely, mark more, or fit the edges"
            )
        uncertainty_px = solution.uncertainty_px(self.instrument.reflector)
        if uncertainty_px > MAX_UNCERTAINTY_PX * max(self.camera.n_columns / 1000.0, 0.5):
            notes.append(
                f"some facets are uncertain by {uncertainty_px:.1f} px: mark more, at the rim and near the middle"
            )
        return notes

    def notes(self, pose: CameraPose) -> list[str]:
        """What a person should know about a pose before using it."""
        notes = []
        turned = turn_note(pose, self.camera, MAX_TURN_RAD)
        if turned is not None:
            notes.append(turned)
        outlines = project_facets(pose, self.instrument.reflector)
        inside = outlines_in_image(outlines, *self.size)
        cut = [i for i, outline in inside.items() if not np.isin(outlines[i], outline).all()]
        if cut:
            notes.append(f"facets {_listed(cut)} reach out of the picture; their outlines end at its edge")
        if absent := [i for i in outlines if i not in inside]:
            notes.append(f"facets {_listed(absent)} are not in the picture")
        return notes

    def save(self, polygons_px: Mapping[int, Array], is_missing_confirmed: bool, how: str) -> Path:
        """Write the map, in the camera's pixels, whole or not at all; `how` it was made goes into its comment.

        Raises
        ------
        ConfigError
            With every fault of the map; facets without an outline count unless confirmed.
        """
        if self.out is None:
            raise ConfigError("there is no file to write to: start again with --out FILE")
        faults = self.faults(polygons_px)
        problems = [f"facet {facet_id}: {text}" for facet_id, texts in sorted(faults.items()) for text in texts]
        if not polygons_px:
            problems.append("the map is empty: draw outlines first")
        elif (missing := self.missing(polygons_px)) and not is_missing_confirmed:
            problems.append(
                f"facets {_listed(missing)} have no outline: draw them, or confirm that they shall be left out"
            )
        if problems:
            raise ConfigError("\n".join(problems))
        model = self.instrument.reflector_camera
        size = (model.n_columns, model.n_rows)
        comments = (
            f"Outlines of {self.instrument.name}'s facets in the reflector camera's {size[0]} x {size[1]} image; "
            "(column, row) of the corners in order, pixel, the centre of the first pixel at (0, 0).",
            f"Made by namod-ctl facets from the picture {self.image_name}: {how}.",
        )
        write_polygon_table(self.out, _inside(scale_polygons(polygons_px, self.size, size), *size), comments)
        return self.out


def _inside(polygons_px: Mapping[int, Array], n_columns: int, n_rows: int) -> dict[int, Array]:
    """Corners that rounding put a hair outside, put back on the image's edge."""
    limit = np.array([n_columns, n_rows]) - 0.5
    return {facet_id: np.clip(outline, -0.5, limit) for facet_id, outline in polygons_px.items()}


def _listed(ids: list[int]) -> str:
    shown = ", ".join(map(str, sorted(ids)[:20]))
    return shown if len(ids) <= 20 else f"{shown} and {len(ids) - 20} more"


def open_workbench(config: str, image: Path, image_pixels: Image, out: Path | None) -> Workbench:
    """The workbench of a config (a built-in name or a path) and a picture, RGB of shape (rows, columns, 3).

    Raises
    ------
    ConfigError
        The config is wrong, or the picture has another aspect ratio than the reflector camera.
    """
    own = _map_file(config)
    # a config may name the file that is about to be made
    instrument = build_instrument(load_config(config, has_map=own is None or own.is_file()))
    try:
        camera = scaled_camera(instrument.reflector_camera, image_pixels.shape[1], image_pixels.shape[0])
    except ConfigError as problem:
        raise ConfigError(f"{image}: {problem}") from None
    return Workbench(instrument, camera, image_pixels, image.name, out if out is not None else own, own)


def scaled_camera(camera: CameraModel, n_columns: int, n_rows: int) -> CameraModel:
    """The camera as if its image had that size. Raises ConfigError for another aspect ratio."""
    axis = scale_polygons({0: camera.axis_pixel[None]}, (camera.n_columns, camera.n_rows), (n_columns, n_rows))[0][0]
    return replace(
        camera,
        n_columns=n_columns,
        n_rows=n_rows,
        plate_scale_rad=camera.plate_scale_rad * camera.n_columns / n_columns,
        axis_pixel=axis,
    )


def _map_file(config: str) -> Path | None:
    """The file in which a config of one's own keeps its map; None for built-in ones, which stay as they are."""
    path = find_config(config)
    if path.resolve().parent == builtin_folder().resolve():
        return None
    section = read_extended(path, find_config)[0].get("reflector_map", {})
    return path.parent / section["polygons_file"] if "polygons_file" in section else None


def png_of(image: Image) -> bytes:
    """The picture as a PNG file."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ConfigError("the picture cannot be written as PNG; give another picture")
    return data.tobytes()
