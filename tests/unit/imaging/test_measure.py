"""From an image pair to a record: directions, intensities and reasons, against made frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
from frames import SIGMA_PX, exposed, gaussian_light
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, hexagon, instrument, resized

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.imaging.dark import dark_of_frames
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record

STAR = resized(STAR_CAMERA, 401, 301)
REFLECTOR = resized(REFLECTOR_CAMERA, 200, 150)
POLYGONS = {1: hexagon(40.3, 40.2, 25.0), 2: hexagon(110.3, 40.2, 25.0), 5: hexagon(75.3, 100.2, 25.0)}
TELESCOPE = instrument(STAR, REFLECTOR, POLYGONS)
FACETS = FacetPhotometer(POLYGONS, [5, 1, 2], 200, 150)


def star_frame(x=250.0, y=100.0, height=150.0, seed=1):
    return exposed(height * gaussian_light((301, 401), x, y, SIGMA_PX), np.random.default_rng(seed))


def reflector_frame(values=(51, 0, 204)):
    """Facets 5, 1 and 2 shine evenly, in three equal channels."""
    frame = np.zeros((150, 200), np.uint8)
    frame[77:125, 49:102] = values[0]
    frame[17:65, 14:67] = values[1]
    frame[17:65, 84:137] = values[2]
    return np.repeat(frame[:, :, None], 3, axis=2)


def record(star=None, reflector=None, **changes):
    star = star_frame() if star is None else star
    reflector = reflector_frame() if reflector is None else reflector
    arguments = {"star_exposure_s": 0.1, "reflector_exposure_s": 0.4, "index": 7, "label": "x_7"} | changes
    return measure_record(star, reflector, instrument=TELESCOPE, photometer=FACETS, **arguments)


def test_the_direction_is_the_plate_scale_times_the_offset_from_the_axis():
    """The star stands 50 columns right of and 50 rows above the axis: theta_x and theta_y are 50 * 2.437 mdeg."""
    found = record()
    assert found.reject_reason is None
    assert (found.index, found.label) == (7, "x_7")
    expected_rad = math.radians(50.0 * 2.437e-3)
    assert found.theta_rad == pytest.approx([expected_rad, expected_rad], abs=4.0 * found.theta_uncertainty_rad)
    # A bright star is found to about a hundredth of a pixel.
    assert 0.003 < math.degrees(found.theta_uncertainty_rad) / 2.437e-3 < 0.03


def test_facets_keep_the_photometers_order_and_a_dark_one_is_zero():
    found = record()
    lit = [10.0 ** (1.03 * math.log10(c / 255.0) - 1.15 * math.log10(0.4) - 0.19) for c in (51, 204)]
    np.testing.assert_allclose(found.facet_intensity, [lit[0], 0.0, lit[1]], rtol=1e-12)
    np.testing.assert_array_equal(found.facet_saturated_share, [0.0, 0.0, 0.0])


def test_the_stars_intensity_carries_its_exposure():
    """The same responses at a tenth of the exposure mean 10**1.23 times the intensity."""
    assert record(star_exposure_s=0.01).star_intensity / record().star_intensity == pytest.approx(10.0**1.23)


def test_a_saturated_facet_rejects_the_record_and_is_named():
    found = record(reflector=reflector_frame((51, 0, 255)))
    assert found.reject_reason is RejectReason.REFLECTOR_SATURATED
    assert "facets 2 (100.0%)" in found.detail
    np.testing.assert_array_equal(found.facet_saturated_share, [0.0, 0.0, 1.0])
    assert np.isfinite(found.theta_rad).all()


def test_a_few_saturated_pixels_do_not_reject():
    reflector = reflector_frame()
    reflector[40, 105:110] = 255
    found = record(reflector=reflector)
    assert found.reject_reason is None
    assert 0.0 < found.facet_saturated_share[2] < 0.01


def test_without_a_star_the_facets_are_measured_all_the_same():
    found = record(star=star_frame(height=0.0))
    assert found.reject_reason is RejectReason.NO_STAR
    assert found.detail
    assert np.isnan(found.theta_rad).all()
    assert math.isnan(found.star_intensity)
    assert math.isnan(found.theta_uncertainty_rad)
    assert found.facet_intensity[2] > 0.0


def test_a_three_channel_copy_of_the_star_frame_gives_the_same_record():
    star = star_frame()
    copied = record(star=np.repeat(star[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(copied.theta_rad, record(star=star).theta_rad)
    assert copied.star_intensity == record(star=star).star_intensity


def test_a_dark_frame_takes_a_hot_cluster_away():
    """A hot cluster of 6 x 6 pixels looks like a second star, until a dark frame shows what it is."""
    rng = np.random.default_rng(4)
    cluster = np.zeros((301, 401))
    cluster[200:206, 100:106] = 120.0
    star = exposed(150.0 * gaussian_light((301, 401), 250.0, 100.0, SIGMA_PX) + cluster, rng)
    assert record(star=star).reject_reason is RejectReason.SEVERAL_STARS
    dark = dark_of_frames(np.stack([exposed(cluster, rng) for _ in range(8)]))
    assert record(star=star, star_dark=dark).reject_reason is None


def test_nothing_is_changed_in_the_frames():
    star, reflector = star_frame(), reflector_frame()
    before = star.copy(), reflector.copy()
    record(star, reflector, star_dark=dark_of_frames(star_frame(height=0.0)[None]))
    np.testing.assert_array_equal(star, before[0])
    np.testing.assert_array_equal(reflector, before[1])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"star": np.zeros((300, 401), np.uint8)}, "star_camera.*300"),
        ({"reflector": np.zeros((768, 1024, 3), np.uint8)}, "reflector_camera.*1024"),
        ({"star_exposure_s": 0.0}, "exposure of 0.0 s"),
        ({"reflector_exposure_s": math.nan}, "exposure of nan s"),
    ],
)
def test_input_of_another_instrument_is_refused(changes, text):
    with pytest.raises(ConfigError, match=text):
        record(**changes)


def test_a_mirrored_camera_turns_theta_x():
    mirrored = replace(STAR, orientation=replace(STAR.orientation, is_mirrored=True))
    found = measure_record(
        star_frame(), reflector_frame(), 0.1, 0.4, instrument(mirrored, REFLECTOR, POLYGONS), FACETS, 0, ""
    )
    np.testing.assert_allclose(found.theta_rad, record().theta_rad * [-1.0, 1.0], rtol=1e-12)
