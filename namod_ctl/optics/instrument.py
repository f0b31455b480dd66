"""A telescope as the whole program sees it: reflector, mounts, cameras and the map of facets in the image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """One telescope with its two cameras, built from a config.

    Attributes
    ----------
    mounts
        Mount of every facet, by facet id.
    facet_polygons_px
        Outline of every facet in the reflector camera's image by facet id, shape (n_corners, 2), (x, y) pixel.
        Empty while no map of the facets has been made.
    goniometer_resolution_rad
        Smallest turn of a bolt a person can make and check.
    star_size_rad
        Expected diameter of a star's image in the star camera (0.025 deg at FACT); the star finder's yardstick.
    bolts_seen_from
        Where people stand when they turn bolts: sheets are drawn as seen from there. No number depends on it.
    """

    name: str
    reflector: Reflector
    mounts: Mapping[int, Mount]
    star_camera: CameraModel
    reflector_camera: CameraModel
    facet_polygons_px: Mapping[int, Array]
    goniometer_resolution_rad: float
    star_size_rad: float
    bolts_seen_from: Literal["front", "back"] = "back"
