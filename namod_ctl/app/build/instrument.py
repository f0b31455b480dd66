"""The composition root: from a config to the objects the program works with."""

from __future__ import annotations

import numpy as np

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.parts import camera_of, mount_of, reflector_of
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.instrument import Instrument


def build_instrument(config: InstrumentConfig) -> Instrument:
    """The telescope that a config describes, in SI units and the telescope frame."""
    mount = config.mount
    return Instrument(
        name=config.telescope.name,
        reflector=reflector_of(config.telescope.focal_length_m, config.facets),
        mounts={
            facet.id: mount_of(mount, mount.facet_orientation_deg.get(str(facet.id), mount.orientation_deg))
            for facet in config.facets
        },
        star_camera=camera_of(config.star_camera),
        reflector_camera=camera_of(config.reflector_camera),
        facet_polygons_px={
            polygon.facet_id: np.array(polygon.corners_px, dtype=np.float64) for polygon in config.polygons
        },
        goniometer_resolution_rad=deg_to_rad(mount.goniometer_resolution_deg),
        star_size_rad=deg_to_rad(config.star_camera.star_diameter_deg),
        bolts_seen_from=mount.bolts_seen_from,
    )
