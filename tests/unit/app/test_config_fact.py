"""FACT's config against the published facts of FACT and the picture its facets were numbered by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.reflector import FacetShape

DATA = Path(__file__).parents[3] / ".." / "shared" / "data" / "fact_2014"
PICTURE_SIZE, CAMERA_SIZE = np.array([1215, 911]), np.array([1024, 768])


@pytest.fixture(scope="module")
def fact() -> Instrument:
    return build_instrument(load_config("fact"))


@pytest.fixture(scope="module")
def picture() -> dict[int, np.ndarray]:
    path = DATA / "published_facet_pixels.csv"
    if not path.is_file():
        pytest.skip("the published picture's facet pixels are not in ../shared/data")
    return {int(row[0]): row[1:] for row in np.loadtxt(path, delimiter=",", skiprows=1)}


def test_the_published_numbers(fact: Instrument) -> None:
    assert fact.reflector.focal_length_m == 4.889
    assert len(fact.reflector.facets) == 30
    assert {(facet.shape, facet.width_m) for facet in fact.reflector.facets} == {(FacetShape.HEXAGON, 0.606)}
    assert fact.star_size_rad == pytest.approx(np.radians(0.025))
    mount = fact.mounts[13]
    expected_m = 0.295 * np.array([[1.0, 0.0], [-0.5, np.sqrt(0.75)], [-0.5, -np.sqrt(0.75)]])
    np.testing.assert_allclose(mount.legs_m, expected_m, atol=1e-15)
    assert mount.pitch_m_per_turn == 1e-3
    # 46.9 deg along the short edge of the reflector camera
    assert np.degrees(768 * fact.reflector_camera.plate_scale_rad) == pytest.approx(46.9, abs=0.01)
    law = fact.star_camera.law
    assert (law.r_resp, law.r_expo, law.r_const) == (1.20, -1.23, 0.99)
    law = fact.reflector_camera.law
    assert (law.r_resp, law.r_expo, law.r_const) == (1.03, -1.15, -0.19)


def test_star_pixels_become_directions_as_in_the_original_program(fact: Instrument) -> None:
    theta_deg = np.degrees(fact.star_camera.theta_of_pixel(np.array([[1290.0, 940.0], [1280.0, 960.0]])))
    np.testing.assert_allclose(theta_deg, [[10 * 0.002437, 20 * 0.002437], [0.0, 0.0]], atol=1e-12)
    assert fact.star_camera.axis_is_calibrated  # the published directions count from the telescope's axis


def test_positions_and_focal_lengths_are_those_measured(fact: Instrument) -> None:
    path = DATA / "fact_facets_measured.txt"
    if not path.is_file():
        pytest.skip("the measured FACT facets are not in ../shared/data")
    measured = np.loadtxt(path, usecols=(0, 1, 2, 6)) / 100.0
    ours = np.array([[*facet.position_m, facet.focal_length_m] for facet in fact.reflector.facets])
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], measured[np.lexsort(measured.T)], atol=1e-9)


def test_ids_belong_to_the_facets_of_the_picture(fact: Instrument, picture: dict[int, np.ndarray]) -> None:
    assert set(fact.reflector.ids) == {0, *picture}
    ids = sorted(picture)
    xy_m = fact.reflector.subset(ids).positions_m[:, :2]
    design = np.column_stack([xy_m, np.ones(len(ids))])
    pixels = np.array([picture[facet_id] for facet_id in ids])
    solution, *_ = np.linalg.lstsq(design, pixels, rcond=None)
    assert np.linalg.norm(pixels - design @ solution, axis=1).max() < 3.0  # read by eye, good to 2 pixels
    assert solution[0, 0] > 200.0  # +x to the right, px per m
    assert solution[1, 1] < -200.0  # +y up


def test_outlines_surround_the_facets_of_the_picture(fact: Instrument, picture: dict[int, np.ndarray]) -> None:
    for facet_id, pixel in picture.items():
        centre_px = (pixel + 0.5) * CAMERA_SIZE / PICTURE_SIZE - 0.5
        corners_px = fact.facet_polygons_px[facet_id]
        if facet_id == 13:
            assert centre_px[0] == pytest.approx(corners_px[:, 0].mean(), abs=3.0)
            continue
        assert len(corners_px) == 6
        np.testing.assert_allclose(corners_px.mean(axis=0), centre_px, atol=2.5)
        assert corners_px[0, 1] < corners_px[1:, 1].min()  # the first corner is the top one
        assert np.ptp(corners_px[:, 1]) > np.ptp(corners_px[:, 0])  # a corner up, flats left and right


def test_corners_of_the_published_outlines_are_met(fact: Instrument) -> None:
    # Corners of the red outlines of 34 (left), 10 (bottom), 31 (top) and 13's cut top, read off the picture.
    read_off = {34: [[236, 560], [236, 638]], 10: [[917, 788]], 31: [[368, 166]], 13: [[547, 59], [601, 59]]}
    for facet_id, corners in read_off.items():
        for corner in corners:
            pixel = (np.array(corner) + 0.5) * CAMERA_SIZE / PICTURE_SIZE - 0.5
            distance_px = np.linalg.norm(fact.facet_polygons_px[facet_id] - pixel, axis=1).min()
            assert distance_px < 4.0, (facet_id, corner)
