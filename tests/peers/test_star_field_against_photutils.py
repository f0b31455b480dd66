"""The same frames of a star field through photutils (finding, centring) and astropy (plate of the matched stars)."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "calibration"))

from star_field_rig import CAMERA, CATALOGUE, FAINT, SITE, STAR_SIZE_RAD, inside, rich_scene

from namod_ctl.calibration.geometry.field_geometry import Watch, solve_field
from namod_ctl.calibration.geometry.star_field import stars_of_frame
from namod_ctl.calibration.sky.observed_sky import observed_directions
from namod_ctl.core.units import mdeg_to_rad
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_field import FalseStar, StarFieldCamera

detection = pytest.importorskip("photutils.detection", reason="photutils is not installed (extra 'peers')")
centroids = pytest.importorskip("photutils.centroids")

FWHM_PX = STAR_SIZE_RAD / CAMERA.plate_scale_rad
EXPOSURE_S = 1.0
CUT_PX = 20


@pytest.fixture(scope="module")
def exposed():
    """A frame of a rich field through a lens without distortion, with three false stars, and its scene."""
    case = rich_scene(np.random.default_rng(21), 10)
    case = replace(case, lens=replace(case.lens, brown_k1=0.0, brown_k2=0.0))
    eyes = StarFieldCamera(CAMERA, Sensor(CAMERA, STAR_CAMERA, "star camera", 21), case.lens, STAR_SIZE_RAD, 21)
    false = (FalseStar(400.3, 500.7, 4.5), FalseStar(1900.2, 300.1, 5.5), FalseStar(1111.0, 1500.5, 6.2))
    return eyes.expose((case.catalogue(), FAINT), case.watch, EXPOSURE_S, false), case


def true_places(case):
    pixel = case.pixels(case.catalogue())
    return pixel[inside(pixel)]


def test_finds_every_star_that_photutils_finds(exposed):
    frame, _ = exposed
    ours = stars_of_frame(frame, CAMERA, STAR_SIZE_RAD).stars
    data = frame.astype(np.float64) - np.median(frame)
    theirs = detection.DAOStarFinder(threshold=8.0, fwhm=FWHM_PX)(data)
    x, y = (np.asarray(theirs[name]) for name in ("x_centroid", "y_centroid"))
    # What is cut by the edge is no star for us, and what stands less than 8 above the sky (4) too near our limit.
    whole = (x > 25) & (y > 25) & (x < CAMERA.n_columns - 26) & (y < CAMERA.n_rows - 26) & (theirs["peak"] > 12)
    distance, _ = cKDTree(ours.pixel).query(np.column_stack([x, y])[whole])
    assert whole.sum() >= 20
    assert distance.max() < 0.5


def test_centres_are_at_least_as_good_as_photutils(exposed):
    frame, case = exposed
    ours = stars_of_frame(frame, CAMERA, STAR_SIZE_RAD).stars
    truth = cKDTree(true_places(case))
    exact = ours.pixel[ours.is_exact]
    distance, nearest = truth.query(exact)
    errors, others = [], []
    for place, apart, number in zip(exact, distance, nearest, strict=True):
        if apart > 1.0:
            continue
        left, top = np.rint(place).astype(int) - CUT_PX
        cut = frame[top : top + 2 * CUT_PX + 1, left : left + 2 * CUT_PX + 1].astype(np.float64)
        x, y = centroids.centroid_2dg(cut - np.median(cut))
        true = truth.data[number]
        errors.append(np.linalg.norm(place - true))
        others.append(np.linalg.norm(np.array([x + left, y + top]) - true))
    assert len(errors) >= 8
    assert np.median(errors) < 0.05
    assert np.median(errors) <= 1.1 * np.median(others)


def test_plate_is_that_of_astropy(exposed):
    """Of the stars that were matched, `fit_wcs_from_points` makes the same plate scale and parity."""
    units = pytest.importorskip("astropy.units")
    from astropy.coordinates import SkyCoord
    from astropy.wcs.utils import fit_wcs_from_points

    frame, case = exposed
    stars = stars_of_frame(frame, CAMERA, STAR_SIZE_RAD).stars
    geometry = solve_field(stars, CATALOGUE, CAMERA, STAR_SIZE_RAD, Watch(case.watch.moment, SITE))
    match = geometry.match
    seen, known = match.seen[match.is_measured], match.known[match.is_measured]
    observed = observed_directions(CATALOGUE, case.watch.moment, SITE)[geometry.known.number[known]]
    lon, lat = np.arctan2(observed[:, 1], observed[:, 0]), np.arcsin(observed[:, 2])
    wcs = fit_wcs_from_points(stars.pixel[seen].T, SkyCoord(lon * units.rad, lat * units.rad), projection="TAN")
    matrix = np.radians(wcs.pixel_scale_matrix)
    scale_rad = abs(np.linalg.det(matrix)) ** 0.5
    assert scale_rad == pytest.approx(geometry.match.fit.plate.plate_scale_rad, abs=mdeg_to_rad(0.0005))
    assert scale_rad == pytest.approx(case.lens.plate_scale_rad, abs=mdeg_to_rad(0.0005))
    # Longitude grows to the left: telescope x. Our matrix turns columns and rows into telescope x and y.
    assert (np.linalg.det(matrix) > 0.0) == case.lens.is_mirrored
    assert geometry.match.fit.plate.is_mirrored == case.lens.is_mirrored
    # A step along the rows is (sin, -cos) of the rotation in telescope x and y.
    lon_deg, lat_deg = wcs.wcs_pix2world(CAMERA.axis_pixel + np.array([[0.0, 0.5], [0.0, -0.5]]), 0).T
    across, along = (lon_deg[0] - lon_deg[1]) * np.cos(np.radians(lat_deg[0])), lat_deg[0] - lat_deg[1]
    apart = np.arctan2(across, -along) - geometry.rotation_rad
    assert abs(np.angle(np.exp(1j * apart))) < np.radians(0.01)
