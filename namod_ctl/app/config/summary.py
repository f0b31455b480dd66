"""What a config says, in words for a person, and what in it deserves a second look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.config.actuator_summary import actuator_rows, actuator_warnings
from namod_ctl.app.config.calibrations import calibrations_of
from namod_ctl.app.config.camera_schema import DeviceCameraSection
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.parts import psf_camera_of
from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.config.schema import LegsMountSection, ReflectorCameraSection, StarCameraSection, TripodMountSection
from namod_ctl.app.views.number_ranges import runs_in_words
from namod_ctl.core.units import m2_to_cm2, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.layouts import facet_area_m2, facet_outline_m

COMMON_FOCAL_RATIOS = (0.8, 2.5)
LEAST_PSF_VIEW_DEG = 0.4
"""Along the shorter edge: FACT's light fell 12 arcmin from its centre before it was aligned."""


@dataclass(frozen=True, slots=True)
class Summary:
    """A titled list of labels and values."""

    title: str
    rows: tuple[tuple[str, str], ...]


def summarize(config: InstrumentConfig, instrument: Instrument) -> list[Summary]:
    """What the config says, one summary per part of the telescope."""
    psf_camera = [] if config.psf_camera is None else [Summary("\nPSF camera", _psf_camera_rows(config.psf_camera))]
    return [
        Summary(f"Telescope {config.telescope.name}", _telescope_rows(config, instrument)),
        Summary("\nMounts", _mount_rows(config, instrument)),
        Summary("\nActuators", actuator_rows(config)),
        Summary("\nStar camera", _camera_rows(config.star_camera, instrument.star_camera)),
        Summary("\nReflector camera", _camera_rows(config.reflector_camera, instrument.reflector_camera)),
        *psf_camera,
        Summary("\nMap of facets", _map_rows(instrument)),
    ]


def warnings_of(config: InstrumentConfig, instrument: Instrument) -> list[str]:
    """What is allowed but may not be meant."""
    warnings = []
    focal_ratio = config.telescope.focal_length_m / _diameter_m(instrument)
    if not COMMON_FOCAL_RATIOS[0] <= focal_ratio <= COMMON_FOCAL_RATIOS[1]:
        warnings.append(f"F/D = {focal_ratio:.2f} is unusual for a Cherenkov telescope")
    if not instrument.star_camera.axis_is_calibrated:
        warnings.append(
            "the star camera has no calibrated axis (axis_px): corrections will aim at the facets' common centre"
        )
    unmapped = [facet_id for facet_id in instrument.reflector.ids if facet_id not in instrument.facet_polygons_px]
    if instrument.facet_polygons_px and unmapped:
        warnings.append(f"facets without an outline in the reflector camera's image: {runs_in_words(unmapped)}")
    if not instrument.facet_polygons_px:
        warnings.append("no map of facets (reflector_map): images cannot be measured, only response maps imported")
    seen_deg, view_deg = _reflector_angle_deg(instrument), _view_deg(instrument.reflector_camera)
    if seen_deg > max(view_deg):
        warnings.append(
            f"the reflector is {seen_deg:.1f} deg wide as seen from the focal point, the reflector camera sees "
            f"{view_deg[0]:.1f} x {view_deg[1]:.1f} deg"
        )
    devices = {"star_camera": config.star_camera.device, "reflector_camera": config.reflector_camera.device}
    without = [name for name, device in devices.items() if device is None]
    if len(without) == 1:
        warnings.append(
            f"{without[0]} has no device, the other camera has one: nothing can be recorded on a sky before "
            f"[{without[0]}.device] says which camera it is"
        )
    if config.psf_camera is not None:
        screen_deg = _view_deg(psf_camera_of(config.psf_camera))
        if min(screen_deg) < LEAST_PSF_VIEW_DEG:
            warnings.append(
                f"the PSF camera sees {screen_deg[0]:.2f} x {screen_deg[1]:.2f} deg of the focal plane: the spot of a "
                f"misaligned mirror and sky around it need {LEAST_PSF_VIEW_DEG:g} deg"
            )
    return warnings + actuator_warnings(config)


def _telescope_rows(config: InstrumentConfig, instrument: Instrument) -> tuple[tuple[str, str], ...]:
    facets = instrument.reflector.facets
    focal_length_m = config.telescope.focal_length_m
    area_m2 = sum(facet_area_m2(facet) for facet in facets)
    diameter_m = _diameter_m(instrument)
    equal_area_m = float(np.sqrt(4.0 * area_m2 / np.pi))
    focal_lengths_m = [facet.focal_length_m for facet in facets]
    heights_m = instrument.reflector.positions_m[:, 2]
    kinds = sorted({f"{facet.shape} {facet.width_m:g} m" for facet in facets})
    if len(kinds) > 3:
        kinds = [*kinds[:3], f"{len(kinds) - 3} more kinds"]
    across = "across" if {str(facet.shape) for facet in facets} == {"round"} else "flat to flat"
    return (
        ("focal length", f"{focal_length_m:g} m"),
        ("facets", f"{len(facets)}, {', '.join(kinds)} {across}"),
        ("ids", runs_in_words(instrument.reflector.ids)),
        ("facet area", _span([m2_to_cm2(facet_area_m2(facet)) for facet in facets], "cm2", ".1f")),
        ("facet focal length", _span(focal_lengths_m, "m", ".4g")),
        ("mirror area", f"{area_m2:.4g} m2, as a disc of {equal_area_m:.4g} m (F/{focal_length_m / equal_area_m:.2f})"),
        ("outer diameter", f"{diameter_m:.4g} m (F/D = {focal_length_m / diameter_m:.2f})"),
        ("facet heights", f"{_span(list(heights_m), 'm', '.3g')} over the dish vertex"),
    )


def _mount_rows(config: InstrumentConfig, instrument: Instrument) -> tuple[tuple[str, str], ...]:
    section = config.mount
    if isinstance(section, TripodMountSection):
        kind = f"tripod, 3 legs 120 deg apart at {section.radius_m:g} m, leg 1 {_compass(section.orientation_deg)}"
    else:
        kind = _legs_in_words(section)
    rows = [("kind", kind)]
    if section.facet_orientation_deg:
        rows.append(("turned otherwise", f"{len(section.facet_orientation_deg)} facets"))
    if section.pitch_mm_per_turn is not None:
        rows.append(("bolts", f"{section.pitch_mm_per_turn:g} mm per turn"))
        rows.append(("sense of turning", f"{section.turn_raises_leg}, as seen by who turns, moves a leg to the sky"))
        side = "behind the mirror" if section.bolts_seen_from == "back" else "in front of the mirror"
        rows.append(("turned from", f"{side}; sheets are drawn as seen from there"))
        rows.append(("goniometer", f"{section.goniometer_resolution_deg:g} deg"))
    else:
        rows.append(("bolts", "none: legs without a pitch, driven by actuators"))
    rows.append(("travel limit", f"{section.travel_limit_mm:g} mm per leg and correction"))
    rows.append(("backlash", f"{section.backlash_um:g} um"))
    return tuple(rows)


def _legs_in_words(section: LegsMountSection) -> str:
    places = ", ".join(f"({x_m:g}, {y_m:g})" for x_m, y_m in section.positions_m)
    fixed = " and a fixed point at the facet's centre" if section.has_fixed_point else ""
    inclined = "inclined" if section.base_joints_m is not None else "straight"
    turned = f", turned by {section.orientation_deg:g} deg" if section.orientation_deg else ""
    return f"{len(section.positions_m)} {inclined} legs at (x, y) = {places} m{turned}{fixed}"


def _psf_camera_rows(section: PsfCameraSection) -> tuple[tuple[str, str], ...]:
    """As for the other cameras, less what has no meaning for this one."""
    rows = _common_rows(section, psf_camera_of(section))
    return (*rows, ("used by align", f"{section.n_frames} frames, from {section.exposure_s:g} s on"))


def _camera_rows(
    section: StarCameraSection | ReflectorCameraSection, camera: CameraModel
) -> tuple[tuple[str, str], ...]:
    rows = [*_common_rows(section, camera), ("orientation", _orientation_in_words(camera))]
    if isinstance(section, StarCameraSection):
        x_px, y_px = camera.axis_pixel
        known = "calibrated" if camera.axis_is_calibrated else "not calibrated, nominal centre of the image"
        rows.append(("optical axis", f"at column {x_px:g}, row {y_px:g} ({known})"))
        rows.append(("star", f"{section.star_diameter_deg:g} deg across"))
    return tuple(rows)


def _common_rows(section: DeviceCameraSection, camera: CameraModel) -> list[tuple[str, str]]:
    law = camera.law
    curve = f" {law.r_curve:+g} (log10 C)^2" if law.r_curve else ""
    width_deg, height_deg = _view_deg(camera)
    serial = f", serial number {section.serial_number}" if section.serial_number is not None else ""
    rows = [
        ("model", f"{section.model}{serial}"),
        ("device", _device_in_words(section)),
        ("image", f"{section.columns} x {section.rows} px, full scale {section.full_scale_adu:g} adu"),
        ("saturated from", f"{camera.saturation_share:.0%} of full scale"),
        ("plate scale", f"{rad_to_mdeg(camera.plate_scale_rad):.6g} mdeg per px"),
        ("field of view", f"{width_deg:.2f} x {height_deg:.2f} deg"),
        ("radiometric law", f"log10 I = {law.r_resp:g} log10 C{curve} {law.r_expo:+g} log10 (T/s) {law.r_const:+g}"),
    ]
    rows += [
        ("calibration", f"{calibration.kind}, of {calibration.made_utc}, valid until {calibration.valid_until_utc}")
        for calibration in calibrations_of(section)
    ]
    return rows


def _device_in_words(section: DeviceCameraSection) -> str:
    """By what the camera is found, for a person who looks for it."""
    device = section.device
    if device is None:
        return "none: the digital twin"
    if device.fed_by_twin:
        return f"{device.driver}, emulated: shown the twin's sky"
    number = f"serial number {section.serial_number}" if section.serial_number is not None else None
    named = [part for part in (number, device.address, device.device) if part is not None]
    return ", ".join([device.driver, *(named or ["the only camera that this driver sees"])])


def _map_rows(instrument: Instrument) -> tuple[tuple[str, str], ...]:
    polygons = instrument.facet_polygons_px
    if not polygons:
        return (("outlines", "none"),)
    corners_px = np.concatenate(list(polygons.values()))
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    return (
        ("outlines", f"{len(polygons)} of {len(instrument.reflector.facets)} facets"),
        ("reach", f"columns {low[0]:.0f} to {high[0]:.0f}, rows {low[1]:.0f} to {high[1]:.0f}"),
    )


def _orientation_in_words(camera: CameraModel) -> str:
    """Where telescope +x and +y lie in the image."""
    to_image = np.linalg.inv(camera.orientation.image_to_telescope)
    mirrored = "mirrored" if camera.orientation.is_mirrored else "not mirrored"
    return f"+x {_image_direction(to_image[:, 0])}, +y {_image_direction(to_image[:, 1])} ({mirrored})"


def _image_direction(offset: NDArray[Any]) -> str:
    """A direction (column, row) as words for someone who looks at the image."""
    angle_deg = rad_to_deg(float(np.arctan2(-offset[1], offset[0]))) % 360.0
    names = {0: "to the right", 90: "up", 180: "to the left", 270: "down"}
    nearest = round(angle_deg / 90.0) * 90
    rest_deg = angle_deg - nearest
    if abs(rest_deg) < 0.005:
        return names[nearest % 360]
    return f"{names[nearest % 360]}, turned {abs(rest_deg):.4g} deg {'counter-' if rest_deg > 0 else ''}clockwise"


def _compass(angle_deg: float) -> str:
    names = {0.0: "at +x", 90.0: "at +y", 180.0: "at -x", 270.0: "at -y"}
    return names.get(angle_deg % 360.0, f"{angle_deg:g} deg from +x towards +y")


def _span(values: list[float], unit: str, form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _outer_radius_m(instrument: Instrument) -> float:
    reflector = instrument.reflector
    outlines = [
        facet_outline_m(facet, normal)
        for facet, normal in zip(reflector.facets, reflector.aligned_normals(), strict=True)
    ]
    return float(np.linalg.norm(np.concatenate(outlines), axis=1).max())


def _diameter_m(instrument: Instrument) -> float:
    return 2.0 * _outer_radius_m(instrument)


def _view_deg(camera: CameraModel) -> tuple[float, float]:
    scale_deg = rad_to_deg(camera.plate_scale_rad)
    return camera.n_columns * scale_deg, camera.n_rows * scale_deg


def _reflector_angle_deg(instrument: Instrument) -> float:
    """Width of the reflector as seen from the focal point."""
    height_m = float(instrument.reflector.positions_m[:, 2].max())
    half_rad = float(np.arctan2(_outer_radius_m(instrument), instrument.reflector.focal_length_m - height_m))
    return 2.0 * rad_to_deg(half_rad)
