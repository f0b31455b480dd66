"""What is wrong between values of a config that are plausible one by one."""

from __future__ import annotations

from collections.abc import Callable, Set

import numpy as np

from namod_ctl.app.config.actuator_problems import actuator_problems
from namod_ctl.app.config.camera_problems import camera_problems, psf_camera_problems
from namod_ctl.app.config.parts import camera_of, mount_of, reflector_of
from namod_ctl.app.config.schema import FacetSection, InstrumentSections
from namod_ctl.app.views.number_ranges import runs_in_words
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.layouts import overlapping_facets
from namod_ctl.optics.polygons import polygon_fault

MAX_RADIUS_SHARE = 1.5  # of the focal length: no Cherenkov telescope is faster than F/D = 0.33
MIN_HEIGHT_SHARE = -0.02  # of the focal length: measured dishes scatter around the vertex, not below
FACET_FOCAL_SHARES = (0.5, 3.0)  # of the telescope's focal length
MAX_OVERLAP_SHARE = 0.02  # of a facet's area: measured positions are good to some mm


def contradictions(config: InstrumentSections, known: Set[str], source: str) -> list[str]:
    """One text per problem, each with key, value, rule and remedy.

    Parameters
    ----------
    config
        Facets and polygons are written out in it.
    known
        The sections that are sound in themselves; no other is looked at, so that it may even be absent.
    """
    return [problem for needed, check in _CHECKS if needed <= known for problem in check(config, source)]


def _facets(config: InstrumentSections) -> tuple[FacetSection, ...]:
    return config.reflector.facets or ()


def _repeated_ids(config: InstrumentSections, source: str) -> list[str]:
    ids = [facet.id for facet in _facets(config)]
    return [
        f"{source}: reflector: facet id {facet_id} occurs {ids.count(facet_id)} times; every facet needs its own"
        for facet_id in sorted(set(ids))
        if ids.count(facet_id) > 1
    ]


def _bad_places(config: InstrumentSections, source: str) -> list[str]:
    """Overlaps mean something only where the places themselves and the ids can be."""
    problems = _misplaced_facets(config, source)
    return problems if problems or _repeated_ids(config, source) else _overlaps(config, source)


def _bad_mount(config: InstrumentSections, source: str) -> list[str]:
    try:
        mount_of(config.mount, config.mount.orientation_deg).check_geometry(f"{source}: mount")
    except ConfigError as problem:
        return [str(problem)]
    return []


def _mounts_of_no_facet(config: InstrumentSections, source: str) -> list[str]:
    ids = {str(facet.id) for facet in _facets(config)}
    return [
        f"{source}: mount.facet_orientation_deg.{key}: there is no facet of this id; take it out or correct it"
        for key in config.mount.facet_orientation_deg
        if key not in ids
    ]


def _bad_actuators(config: InstrumentSections, source: str) -> list[str]:
    if config.actuators is None:
        return []
    return actuator_problems(config.actuators, config.mount, [facet.id for facet in _facets(config)], source)


def _misplaced_facets(config: InstrumentSections, source: str) -> list[str]:
    focal_length_m = config.telescope.focal_length_m
    problems = []
    for facet in _facets(config):
        x_m, y_m, z_m = facet.position_m
        radius_m = float(np.hypot(x_m, y_m))
        share = facet.focal_length_m / focal_length_m
        if radius_m > MAX_RADIUS_SHARE * focal_length_m:
            problems.append(
                f"{source}: reflector: facet {facet.id} stands {radius_m:g} m from the axis, more than "
                f"{MAX_RADIUS_SHARE:g} focal lengths of {focal_length_m:g} m: check the unit of positions"
            )
        if not MIN_HEIGHT_SHARE * focal_length_m <= z_m < focal_length_m:
            problems.append(
                f"{source}: reflector: facet {facet.id} has z = {z_m:g} m, must lie from {MIN_HEIGHT_SHARE:g} "
                f"to 1 focal length of {focal_length_m:g} m over the dish vertex: check sign and unit"
            )
        if not FACET_FOCAL_SHARES[0] <= share <= FACET_FOCAL_SHARES[1]:
            problems.append(
                f"{source}: reflector: facet {facet.id} has focal_length_m = {facet.focal_length_m:g}, must be "
                f"{FACET_FOCAL_SHARES[0]:g} to {FACET_FOCAL_SHARES[1]:g} of the telescope's {focal_length_m:g} m: "
                "check the unit, and that it is no radius of curvature"
            )
    return problems


def _overlaps(config: InstrumentSections, source: str) -> list[str]:
    """Facets that stand in each other's place: a position, width or id list is wrong."""
    pairs = overlapping_facets(reflector_of(config.telescope.focal_length_m, _facets(config)))
    return [
        f"{source}: reflector: facets {first} and {second} overlap by {share:.0%} of a facet, at most "
        f"{MAX_OVERLAP_SHARE:.0%} pass as error of measurement: check positions, width_m and rotation_deg"
        for first, second, share in pairs
        if share > MAX_OVERLAP_SHARE
    ]


def _bad_polygons(config: InstrumentSections, source: str) -> list[str]:
    if config.reflector_map is None:
        return []
    camera = config.reflector_camera
    ids = {facet.id for facet in _facets(config)}
    problems = []
    seen: set[int] = set()
    for polygon in config.reflector_map.polygons or ():
        where = f"{source}: reflector_map: the polygon of facet {polygon.facet_id}"
        if polygon.facet_id not in ids:
            problems.append(f"{where}: the reflector has no facet of this id; its ids are {runs_in_words(ids)}")
        if polygon.facet_id in seen:
            problems.append(f"{where} occurs twice; every facet has one outline")
        seen.add(polygon.facet_id)
        corners_px = np.array(polygon.corners_px, dtype=np.float64).reshape(-1, 2)
        fault = polygon_fault(corners_px, camera.columns, camera.rows)
        if fault is not None:
            problems.append(f"{where}: {fault}")
    return problems


def _bad_target(config: InstrumentSections, source: str) -> list[str]:
    if config.recording is None:
        return []
    share = config.recording.brightest_pixel_share
    cameras = (("star_camera", config.star_camera), ("reflector_camera", config.reflector_camera))
    return [
        f"{source}: recording.brightest_pixel_share = {share:g} must be less than {name}.saturation_share = "
        f"{saturation_share:g}: every frame would be saturated"
        for name, camera in cameras
        if share >= (saturation_share := camera_of(camera).saturation_share)
    ]


_CHECKS: tuple[tuple[frozenset[str], Callable[[InstrumentSections, str], list[str]]], ...] = (
    (frozenset({"reflector"}), _repeated_ids),
    (frozenset({"reflector", "telescope"}), _bad_places),
    (frozenset({"mount"}), _bad_mount),
    (frozenset({"mount", "reflector"}), _mounts_of_no_facet),
    (frozenset({"actuators", "mount", "reflector"}), _bad_actuators),
    (frozenset({"reflector", "reflector_camera", "reflector_map"}), _bad_polygons),
    (frozenset({"recording", "star_camera", "reflector_camera"}), _bad_target),
    (frozenset({"star_camera", "reflector_camera"}), camera_problems),
    (frozenset({"star_camera", "reflector_camera", "psf_camera"}), psf_camera_problems),
)
