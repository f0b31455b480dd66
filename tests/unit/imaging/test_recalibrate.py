"""Records put on other calibrations by numbers alone are what measuring their frames anew gives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from frames import SIGMA_PX, exposed, gaussian_light
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, hexagon, instrument, resized

from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record
from namod_ctl.imaging.recalibrate import recalibrated, why_frames_are_needed
from namod_ctl.optics.camera_model import DarkModel, Distortion, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation

POLYGONS = {1: hexagon(40.3, 40.2, 25.0), 2: hexagon(110.3, 40.2, 25.0)}
FACETS = FacetPhotometer(POLYGONS, [1, 2], 200, 150)
STAR, REFLECTOR = resized(STAR_CAMERA, 401, 301), resized(REFLECTOR_CAMERA, 200, 150)
OLD = instrument(STAR, REFLECTOR, POLYGONS)
NEW = instrument(
    replace(
        STAR,
        plate_scale_rad=1.01 * STAR.plate_scale_rad,
        axis_pixel=np.array([190.0, 160.0]),
        orientation=CameraOrientation(math.radians(2.0), is_mirrored=True),
        distortion=Distortion(np.array([200.0, 150.0]), -0.3333),
        law=RadiometricLaw(1.20, -1.30, 1.05),
    ),
    replace(REFLECTOR, law=RadiometricLaw(1.03, -1.10, -0.25)),
    POLYGONS,
)


def record(telescope):
    rng = np.random.default_rng(3)
    star = exposed(150.0 * gaussian_light((301, 401), 250.3, 100.6, SIGMA_PX), rng)
    reflector = rng.integers(10, 200, (150, 200), dtype=np.uint8)
    return measure_record(star, reflector, 0.07, 0.4, telescope, FACETS, 1, "one")


def test_numbers_follow_geometry_exposure_and_constant_as_frames_would():
    by_numbers, by_frames = recalibrated(record(OLD), OLD, NEW), record(NEW)
    # the windows in which the star is measured follow the plate scale: 1e-4 px
    assert by_numbers.theta_rad == pytest.approx(by_frames.theta_rad, abs=1e-4 * STAR.plate_scale_rad)
    assert by_numbers.theta_uncertainty_rad == pytest.approx(by_frames.theta_uncertainty_rad, rel=1e-3)
    assert by_numbers.star_intensity == pytest.approx(by_frames.star_intensity, rel=1e-3)
    np.testing.assert_allclose(by_numbers.facet_intensity, by_frames.facet_intensity, rtol=1e-9)
    assert why_frames_are_needed(OLD.star_camera, NEW.star_camera) == ()


def test_intensities_follow_to_the_last_digit_where_the_geometry_stays():
    laws = instrument(replace(STAR, law=NEW.star_camera.law), NEW.reflector_camera, POLYGONS)
    by_numbers, by_frames = recalibrated(record(OLD), OLD, laws), record(laws)
    assert by_numbers.star_intensity == pytest.approx(by_frames.star_intensity, rel=1e-12)
    np.testing.assert_allclose(by_numbers.facet_intensity, by_frames.facet_intensity, rtol=1e-12)


def test_what_only_frames_can_follow_is_named():
    hot = np.array([[3, 4]])
    for changed, word in (
        (replace(STAR, law=RadiometricLaw(1.25, -1.23, 0.99)), "r_resp"),
        (replace(STAR, law=RadiometricLaw(1.20, -1.23, 0.99, 0.05)), "r_curve"),
        (replace(STAR, saturation_share=0.9), "saturation"),
        (replace(STAR, dark=DarkModel(3.0, 0.0, hot)), "dark"),
    ):
        (reason,) = why_frames_are_needed(STAR, changed)
        assert word in reason
    with_dark = replace(STAR, dark=DarkModel(3.0, 0.0, hot))
    assert why_frames_are_needed(with_dark, replace(STAR, dark=DarkModel(3.0, 0.0, hot.copy()))) == ()
