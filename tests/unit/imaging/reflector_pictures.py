"""Pictures of the twin's reflector by a camera that stands elsewhere than the config says, and what is true in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.polygons import clip_to_image
from namod_ctl.twin.settings import PERFECT, CameraSettings, SkySettings, TwinSettings
from namod_ctl.twin.surface_map import outline_m
from namod_ctl.twin.twin import Twin

THOUSAND_FACETS = """
[telescope]
name = "1000 facets"
focal_length_m = 28.0
[reflector.layout]
shape = "hexagon"
width_m = 0.64
spacing_m = 0.66
inner_radius_m = 0.5
outer_radius_m = 10.83
parabola_share = 1.0
"""


def instrument_of(name: str, folder: Path) -> Instrument:
    """A built-in instrument, or `thousand`, with no map of its facets."""
    if name == "thousand":
        text = (builtin_folder() / "lst_like.toml").read_text()
        path = folder / "thousand.toml"
        path.write_text(THOUSAND_FACETS + text[text.index("[mount]") :])
        return build_instrument(load_config(path))
    return replace(build_instrument(load_config(name)), facet_polygons_px={})


@dataclass(frozen=True)
class TrueCamera:
    """A pinhole: where it stands (m, from the focal point), how it is turned (rad, about x, y, z), its lens."""

    away_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal_px: float = 938.0
    is_mirrored: bool = False


def true_pixels(points_m: np.ndarray, instrument: Instrument, camera: TrueCamera) -> np.ndarray:
    """Pixel of points (..., 3), written out from the text of the conventions and not by the program's own functions.

    A person at the focal point who looks down sees +x to the right and +y up, so rows count along -y.
    """
    tilt_x, tilt_y, turn = camera.turned_rad
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt_x), -np.sin(tilt_x)], [0, np.sin(tilt_x), np.cos(tilt_x)]])
    about_y = np.array([[np.cos(tilt_y), 0, np.sin(tilt_y)], [0, 1, 0], [-np.sin(tilt_y), 0, np.cos(tilt_y)]])
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    place_m = np.array([0.0, 0.0, instrument.reflector.focal_length_m]) + camera.away_m
    x, y, z = np.moveaxis((points_m - place_m) @ (about_z @ about_y @ about_x), -1, 0)
    right, up = x / -z * camera.focal_px, y / -z * camera.focal_px
    if camera.is_mirrored:
        right = -right
    return np.stack([right, -up], axis=-1) + instrument.reflector_camera.axis_pixel


def true_outlines(instrument: Instrument, camera: TrueCamera) -> dict[int, np.ndarray]:
    """Outline of every facet by id, shape (n_corners, 2), pixel; a facet's x axis has no part along y."""
    focus = np.array([0.0, 0.0, instrument.reflector.focal_length_m])
    outlines = {}
    for facet in instrument.reflector.facets:
        to_focus = (focus - facet.position_m) / np.linalg.norm(focus - facet.position_m)
        normal = to_focus + np.array([0.0, 0.0, 1.0])
        normal /= np.linalg.norm(normal)
        axis = np.cross([0.0, 0.0, 1.0], normal)  # the shortest turn of +z onto the normal, by Rodrigues' formula
        sine, cosine = np.linalg.norm(axis), normal[2]
        flat = np.column_stack([outline_m(facet), np.zeros(len(outline_m(facet)))])
        if sine > 0.0:
            axis = axis / sine
            flat = flat * cosine + np.cross(axis, flat) * sine + np.outer(flat @ axis, axis) * (1.0 - cosine)
        outlines[facet.id] = true_pixels(facet.position_m + flat, instrument, camera)
    return outlines


def twin_picture(instrument: Instrument, camera: TrueCamera, seed: int) -> np.ndarray:
    """The twin's frame with all facets lit by a star, shape (rows, columns, 3), 8 bit, in that camera's view.

    A star on the axis of a dish without misalignment lights every facet; the scene about it is half as bright.
    """
    model = instrument.reflector_camera
    outlines = true_outlines(instrument, camera)
    clipped = {i: clip_to_image(outline, model.n_columns, model.n_rows) for i, outline in outlines.items()}
    mapped = replace(instrument, facet_polygons_px={i: outline for i, outline in clipped.items() if len(outline) >= 3})
    settings = TwinSettings(
        sky=SkySettings(scintillation=0.0),
        telescope=replace(
            TwinSettings().telescope, jitter_rad=0.0, radius_rad=arcmin_to_rad(0.001), spacing_rad=deg_to_rad(0.1)
        ),
        reflector=PERFECT,
        reflector_camera=CameraSettings(exposure_at_mag0_s=0.25, background_share=0.15),
        aperture_radius_m=0.02 * instrument.reflector.focal_length_m,
    )
    twin = Twin(mapped, settings, seed)
    twin.star_camera.start(0.05)
    twin.reflector_camera.start(0.25)
    twin.star_camera.fetch(1.0)
    return twin.reflector_camera.fetch(1.0).image
