"""Cameras and an instrument for the tests, with FACT's published calibration (arXiv:1605.06274, section 3)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

STAR_CAMERA = CameraModel(
    name="star_camera",
    n_columns=2560,
    n_rows=1920,
    plate_scale_rad=math.radians(2.437e-3),
    axis_pixel=np.array([1279.5, 959.5]),
    axis_is_calibrated=True,
    orientation=CameraOrientation(),
    law=RadiometricLaw(1.20, -1.23, 0.99),
)

REFLECTOR_CAMERA = CameraModel(
    name="reflector_camera",
    n_columns=1024,
    n_rows=768,
    plate_scale_rad=math.radians(46.9 / 768),
    axis_pixel=np.array([511.5, 383.5]),
    axis_is_calibrated=False,
    orientation=CameraOrientation(),
    law=RadiometricLaw(1.03, -1.15, -0.19),
)

STAR_SIZE_RAD = math.radians(0.025)


def resized(camera: CameraModel, n_columns: int, n_rows: int) -> CameraModel:
    """The camera with a smaller sensor, for quick tests."""
    axis = np.array([(n_columns - 1) / 2, (n_rows - 1) / 2])
    return replace(camera, n_columns=n_columns, n_rows=n_rows, axis_pixel=axis)


def hexagon(x: float, y: float, radius: float) -> NDArray[np.float64]:
    """Corners, shape (6, 2), of a hexagon with a corner to the right."""
    turn = np.arange(6) * np.pi / 3.0
    return np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], axis=1)


def hexagons() -> dict[int, NDArray[np.float64]]:
    """Thirty facets as large as FACT's in its reflector image: 10 300 pixels each, 6 columns by 5 rows."""
    return {
        1 + column + 6 * row: hexagon(105.3 + 160.0 * column, 80.2 + 150.0 * row, 63.0)
        for row in range(5)
        for column in range(6)
    }


def instrument(
    star_camera: CameraModel = STAR_CAMERA,
    reflector_camera: CameraModel = REFLECTOR_CAMERA,
    polygons: dict[int, NDArray[np.float64]] | None = None,
) -> Instrument:
    """An instrument with those cameras; its reflector and mounts do not matter to imaging."""
    polygons = hexagons() if polygons is None else polygons
    facets = tuple(Facet(i, np.array([0.0, 0.0, 0.0]), 4.9, FacetShape.HEXAGON, 0.606) for i in polygons)
    mount = Mount(np.array([[0.295, 0.0], [-0.15, 0.26], [-0.15, -0.26]]), False, 0.01)
    return Instrument(
        name="test",
        reflector=Reflector(4.889, facets),
        mounts=dict.fromkeys(polygons, mount),
        star_camera=star_camera,
        reflector_camera=reflector_camera,
        facet_polygons_px=polygons,
        goniometer_resolution_rad=math.radians(5.0),
        star_size_rad=STAR_SIZE_RAD,
    )
