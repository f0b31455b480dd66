"""Facet photometry against areas and light that are known, and against scipy.ndimage as an independent program."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from imaging_instruments import REFLECTOR_CAMERA, hexagon, hexagons, resized
from scipy import ndimage

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.facets import FacetPhotometer, pixels_of_polygon

CAMERA = resized(REFLECTOR_CAMERA, 200, 150)
SQUARE = np.array([[9.5, 19.5], [49.5, 19.5], [49.5, 59.5], [9.5, 59.5]])
COMB = np.array([[60, 10], [180, 10], [180, 90], [150, 90], [150, 30], [120, 30], [120, 90], [60, 90]], float) - 0.5


def by_the_law(response, exposure_s):
    """arXiv:1605.06274 with the reflector camera's coefficients."""
    return 10.0 ** (1.03 * np.log10(np.asarray(response) / 255.0) - 1.15 * np.log10(exposure_s) - 0.19)


def photometer(polygons):
    return FacetPhotometer(polygons, list(polygons), 200, 150)


def test_the_pixels_of_a_square_are_counted_exactly():
    assert photometer({1: SQUARE}).n_pixels[0] == 40 * 40


def test_a_polygon_with_a_bay_leaves_the_bay_out():
    frame = np.full((150, 200), 51, np.uint8)
    frame[31:90, 121:149] = 255
    light = photometer({4: COMB}).measure(frame, CAMERA, 0.1)
    assert light.intensity[0] == pytest.approx(by_the_law(51, 0.1), rel=1e-12)
    assert light.saturated_share[0] == 0.0
    assert photometer({4: COMB}).n_pixels[0] == 120 * 80 - 30 * 60


def test_intensity_is_the_mean_of_intensities_not_the_intensity_of_the_mean():
    frame = np.zeros((150, 200), np.uint8)
    frame[20:60, 10:30] = 204
    frame[20:60, 30:50] = 51
    light = photometer({1: SQUARE}).measure(frame, CAMERA, 0.02)
    assert light.intensity[0] == pytest.approx(by_the_law([204, 51], 0.02).mean(), rel=1e-12)


def test_a_colour_is_the_mean_of_its_channels_intensities_and_copies_are_grey():
    frame = np.zeros((150, 200, 3), np.uint8)
    frame[:] = (30, 60, 120)
    light = photometer({1: SQUARE}).measure(frame, CAMERA, 0.02)
    assert light.intensity[0] == pytest.approx(by_the_law([30, 60, 120], 0.02).mean(), rel=1e-12)
    grey = np.random.default_rng(1).integers(0, 255, (150, 200)).astype(np.uint8)
    facets = photometer({1: SQUARE, 2: COMB})
    np.testing.assert_allclose(
        facets.measure(np.repeat(grey[:, :, None], 3, 2), CAMERA, 0.02).intensity,
        facets.measure(grey, CAMERA, 0.02).intensity,
        rtol=1e-12,
    )


def test_a_dark_facet_is_zero_and_saturation_is_judged_by_channel():
    frame = np.zeros((150, 200, 3), np.uint8)
    frame[20:24, 10:50, 2] = 255
    light = photometer({7: COMB, 3: SQUARE}).measure(frame, CAMERA, 0.02)
    assert light.intensity[0] == 0.0
    np.testing.assert_allclose(light.saturated_share, [0.0, 0.1])


def test_sixteen_bit_frames_follow_the_same_law():
    frame = np.full((150, 200), 819, np.uint16)
    light = photometer({1: SQUARE}).measure(frame, replace(CAMERA, full_scale_adu=4095.0), 0.1)
    assert light.intensity[0] == pytest.approx(by_the_law(51, 0.1), rel=1e-9)


def test_thirty_facets_agree_with_scipy():
    """scipy sums the pixels whose centres lie inside, as a rasteriser of its own marks them."""
    frame = np.random.default_rng(2).integers(0, 256, (768, 1024)).astype(np.uint8)
    polygons = hexagons()
    labels = np.zeros(frame.shape, np.int32)
    y, x = np.mgrid[:768, :1024].astype(float)
    for number, corners in polygons.items():
        edge = np.roll(corners, -1, axis=0) - corners
        side = [e[0] * (y - c[1]) - e[1] * (x - c[0]) for c, e in zip(corners, edge, strict=True)]
        labels[np.all(np.array(side) > 0.0, axis=0)] = number
    expected = ndimage.mean(np.where(frame > 0, by_the_law(np.maximum(frame, 1), 0.1), 0.0), labels, list(polygons))
    light = FacetPhotometer(polygons, list(polygons), 1024, 768).measure(frame, REFLECTOR_CAMERA, 0.1)
    np.testing.assert_allclose(light.intensity, expected, rtol=1e-9)


def test_a_thousand_facets_of_every_order():
    polygons = {i: hexagon(15.0 + 31.0 * (i % 32), 12.0 + 23.0 * (i // 32), 11.0) for i in range(1024)}
    ids = list(polygons)[::-1]
    frame = np.zeros((768, 1024), np.uint8)
    cv2.circle(frame, (15 + 31 * 5, 12 + 23 * 7), 12, 200, -1)
    light = FacetPhotometer(polygons, ids, 1024, 768).measure(frame, REFLECTOR_CAMERA, 1.0)
    assert ids[int(np.argmax(light.intensity))] == 5 + 32 * 7
    assert np.count_nonzero(light.intensity) == 1


@given(
    centre=st.tuples(st.floats(40, 160), st.floats(40, 110)),
    radii=st.lists(st.floats(5, 38), min_size=3, max_size=12),
    turn=st.floats(0, 6.3),
)
@settings(deadline=None, max_examples=60)
def test_any_star_shaped_polygon_has_its_area_in_pixels(centre, radii, turn):
    """The shoelace area; the pixels along the outline are in or out, so it is true to about half of these."""
    angle = turn + np.arange(len(radii)) * 2.0 * np.pi / len(radii)
    corners = np.array(centre) + np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y = corners.T
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    outline = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T).sum()
    for sense in (corners, corners[::-1]):
        assert pixels_of_polygon(sense, 200, 150, "facet").size == pytest.approx(area, abs=0.5 * outline + 1.0)


def test_neighbours_share_no_pixel_and_leave_none_out():
    left = np.array([[10.0, 10.0], [50.0, 12.0], [61.0, 70.0], [12.0, 80.0]])
    right = np.array([[50.0, 12.0], [90.0, 15.0], [88.0, 77.0], [61.0, 70.0]])
    both = np.array([[10.0, 10.0], [50.0, 12.0], [90.0, 15.0], [88.0, 77.0], [61.0, 70.0], [12.0, 80.0]])
    parts = [pixels_of_polygon(p, 200, 150, "facet") for p in (left, right)]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), pixels_of_polygon(both, 200, 150, "facet"))


@pytest.mark.parametrize(
    ("corners", "text"),
    [
        ([[10, 10], [50, 50], [50, 10], [10, 50]], "crosses or touches itself"),
        ([[10, 10], [50, 10], [90, 10]], "crosses or touches itself"),
        ([[10, 10], [50, 10], [30, 10], [30, 60]], "crosses or touches itself"),
        ([[10, 10], [50, 10], [50, 50], [30, 10], [10, 50]], "crosses or touches itself"),
        ([[10, 10], [10, 10], [50, 50], [10, 50]], "crosses or touches itself"),
        ([[190, 10], [201, 10], [190, 50]], "x = 201, y = 10"),
        ([[-3, 10], [20, 10], [20, 50]], "outside the image of 200 x 150"),
        ([[np.nan, 10], [20, 10], [20, 50]], "outside"),
        ([[10, 10], [20, 10]], "3 or more corners"),
        ([[10.1, 10.1], [10.4, 10.1], [10.4, 10.4]], "no pixel at all"),
    ],
)
def test_a_polygon_that_is_none_is_refused(corners, text):
    with pytest.raises(ConfigError, match=f"(?s)facet 17.*{text}"):
        photometer({17: np.array(corners, float)})


def test_a_closed_outline_is_the_same_polygon():
    closed = np.concatenate([SQUARE, SQUARE[:1]])
    np.testing.assert_array_equal(
        pixels_of_polygon(closed, 200, 150, "facet"), pixels_of_polygon(SQUARE, 200, 150, "facet")
    )


def test_a_facet_without_polygon_is_named():
    with pytest.raises(ConfigError, match=r"\[3\] have no polygon"):
        FacetPhotometer({1: SQUARE}, [1, 3], 200, 150)
