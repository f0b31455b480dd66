"""The recorder's exposures and the crew's magnitude on the twin's frames: FACT, its star camera cropped to be quick."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.interfaces import Camera
from namod_ctl.cycle.pairs import SourceStatus
from namod_ctl.cycle.progress import Progress, Tracker
from namod_ctl.imaging.exposure import (
    ExposureVerdict,
    exposure_rule,
    frame_statistics,
    judge_exposure,
    next_exposure_s,
)
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.twin.settings import FaultSpec, SkySettings, TwinSettings
from namod_ctl.twin.sky import CATALOGUE
from namod_ctl.twin.twin import Twin

MAX_RETAKES = 3
STARTS_S = np.geomspace(1e-3, 3.0, 15)
STARS = {"Jupiter": -2.5, "Sirius": -1.46, "Vega": 0.03, "Polaris": 2.02, "Megrez": 3.31}
EXTINCTION_MAG = 0.12


@cache
def cropped_fact() -> InstrumentConfig:
    raw = load_config("fact").model_dump(exclude_none=True)
    raw["star_camera"] |= {"columns": 512, "rows": 384, "axis_px": [256.0, 192.0]}
    return InstrumentConfig.model_validate(raw)


def twin_at(star: str, *faults: FaultSpec, scintillation: float = 1.0) -> Twin:
    """The twin that looks at a star when it stands highest."""
    sky = SkySettings(
        reference_star=star,
        sidereal_time_rad=CATALOGUE[star].right_ascension_rad,
        extinction_mag=EXTINCTION_MAG,
        scintillation=scintillation,
    )
    return build_twin(cropped_fact(), replace(TwinSettings(), sky=sky, faults=faults), 20261122)


def n_retakes_from(camera: Camera, model: CameraModel, exposure_s: float) -> int:
    """Frames that are taken again until one is good; the telescope wanders meanwhile."""
    rule = exposure_rule(model, *camera.exposure_range_s)
    for n in range(MAX_RETAKES + 2):
        camera.start(exposure_s)
        frame = camera.fetch(5.0)
        statistics = frame_statistics(frame.image, model)
        exposure_s = next_exposure_s(statistics, frame.exposure_s, rule)
        if judge_exposure(statistics, frame.exposure_s, rule) is ExposureVerdict.GOOD:
            return n
    return MAX_RETAKES + 2


@pytest.mark.parametrize("star", STARS)
def test_exposures_recover_from_any_start(star: str) -> None:
    twin = twin_at(star)
    cameras = (
        (twin.star_camera, twin.instrument.star_camera),
        (twin.reflector_camera, twin.instrument.reflector_camera),
    )
    for camera, model in cameras:
        retakes = [n_retakes_from(camera, model, float(start_s)) for start_s in STARTS_S]
        assert max(retakes) <= MAX_RETAKES, f"{model.name}: {retakes} from {STARTS_S}"


def progress_of(twin: Twin, exposure_s: float, zero_point_mag: float | None) -> Progress:
    """What the crew is shown after one record."""
    twin.star_camera.start(exposure_s)
    twin.reflector_camera.start(0.5)
    star, reflector = twin.star_camera.fetch(5.0), twin.reflector_camera.fetch(5.0)
    camera = twin.instrument.reflector_camera
    photometer = FacetPhotometer(twin.instrument.facet_polygons_px, (0, 2), camera.n_columns, camera.n_rows)
    record = measure_record(
        star.image, reflector.image, star.exposure_s, reflector.exposure_s, twin.instrument, photometer, 0, ""
    )
    tracker = Tracker(0.006, 0.0, zero_point_mag)
    tracker.add(record, 1.0, SourceStatus({}, 0, ""))
    return tracker.snapshot(1.0, SourceStatus({}, 0, ""), None)


def true_magnitude(twin: Twin, star: str) -> float:
    """As seen from the ground: air mass 1 / cos z."""
    zenith_rad = twin.sky.zenith_distance_rad(twin.clock.monotonic_s())
    return STARS[star] + EXTINCTION_MAG / math.cos(zenith_rad)


def test_the_magnitude_is_that_of_the_catalogue_and_the_air() -> None:
    """The zero point comes from one star; magnitudes of the others, 100 times brighter to fainter, follow.

    Without scintillation, which in 12 ms at 45 deg makes Sirius as uncertain as 0.3 mag.
    """
    vega = twin_at("Vega", scintillation=0.0)
    zero_point_mag = true_magnitude(vega, "Vega") - progress_of(vega, 0.04, 0.0).star_magnitude
    for star, exposure_s in (("Sirius", 0.012), ("Polaris", 0.3), ("Megrez", 0.7), ("Vega", 0.02)):
        twin = twin_at(star, scintillation=0.0)
        shown = progress_of(twin, exposure_s, zero_point_mag)
        assert not shown.is_magnitude_relative
        assert shown.star_magnitude == pytest.approx(true_magnitude(twin, star), abs=0.1), star
