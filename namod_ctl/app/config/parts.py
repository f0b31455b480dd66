"""The parts of an instrument, each from its sections of the config."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from namod_ctl.app.config.calibrations import calibrated, calibrations_of
from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.config.schema import (
    FacetSection,
    LegsMountSection,
    ReflectorCameraSection,
    StarCameraSection,
    TripodMountSection,
)
from namod_ctl.core.units import deg_to_rad, mdeg_to_rad, mm_to_m, um_to_m
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

TRIPOD_ARMS_DEG = np.array([0.0, 120.0, 240.0])


def reflector_of(focal_length_m: float, sections: Sequence[FacetSection]) -> Reflector:
    """The reflector of these facets, in their order."""
    facets = tuple(
        Facet(
            id=section.id,
            position_m=np.array(section.position_m, dtype=np.float64),
            focal_length_m=section.focal_length_m,
            shape=FacetShape(section.shape),
            width_m=section.width_m,
            rotation_rad=deg_to_rad(section.rotation_deg),
        )
        for section in sections
    )
    return Reflector(focal_length_m, facets)


def mount_of(section: TripodMountSection | LegsMountSection, orientation_deg: float) -> Mount:
    """The mount that the section describes, its legs turned by `orientation_deg` from telescope +x towards +y."""
    base_joints_m = None
    if isinstance(section, TripodMountSection):
        arm_rad = deg_to_rad(TRIPOD_ARMS_DEG + orientation_deg)
        legs_m = section.radius_m * np.column_stack([np.cos(arm_rad), np.sin(arm_rad)])
        has_fixed_point = False
    else:
        cosine, sine = np.cos(deg_to_rad(orientation_deg)), np.sin(deg_to_rad(orientation_deg))
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        legs_m = np.array(section.positions_m, dtype=np.float64) @ turn[:2, :2].T
        has_fixed_point = section.has_fixed_point
        if section.base_joints_m is not None:
            base_joints_m = np.array(section.base_joints_m, dtype=np.float64) @ turn.T
    return Mount(
        legs_m=legs_m,
        has_fixed_point=has_fixed_point,
        travel_limit_m=mm_to_m(section.travel_limit_mm),
        backlash_m=um_to_m(section.backlash_um),
        pitch_m_per_turn=None if section.pitch_mm_per_turn is None else mm_to_m(section.pitch_mm_per_turn),
        turn_raises_leg=section.turn_raises_leg or "clockwise",
        base_joints_m=base_joints_m,
    )


def psf_camera_of(section: PsfCameraSection) -> CameraModel:
    """The PSF camera, by its calibrations where it has any; the middle of its image stands for the telescope's axis."""
    law = section.radiometric_law
    camera = CameraModel(
        name=section.model,
        n_columns=section.columns,
        n_rows=section.rows,
        plate_scale_rad=mdeg_to_rad(section.plate_scale_mdeg_per_px),
        axis_pixel=np.array([section.columns / 2.0, section.rows / 2.0]),
        axis_is_calibrated=False,
        orientation=CameraOrientation(),
        law=RadiometricLaw(1.0, -1.0, 0.0) if law is None else RadiometricLaw(law.r_resp, law.r_expo, law.r_const),
        full_scale_adu=section.full_scale_adu,
        saturation_share=section.saturation_share,
    )
    return calibrated(camera, calibrations_of(section))


def camera_of(section: StarCameraSection | ReflectorCameraSection) -> CameraModel:
    """One camera, by its calibrations where it has any.

    Without a calibrated axis its nominal centre, half its width and height, stands for it.
    """
    axis_px = (section.columns / 2.0, section.rows / 2.0) if section.axis_px is None else section.axis_px
    law = section.radiometric_law
    camera = CameraModel(
        name=section.model,
        n_columns=section.columns,
        n_rows=section.rows,
        plate_scale_rad=mdeg_to_rad(section.plate_scale_mdeg_per_px),
        axis_pixel=np.array(axis_px, dtype=np.float64),
        axis_is_calibrated=section.axis_px is not None,
        orientation=CameraOrientation(deg_to_rad(section.rotation_deg), section.mirrored),
        law=RadiometricLaw(law.r_resp, law.r_expo, law.r_const),
        full_scale_adu=section.full_scale_adu,
        saturation_share=section.saturation_share,
    )
    return calibrated(camera, calibrations_of(section))
