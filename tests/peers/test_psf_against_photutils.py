"""The PSF camera's numbers beside photutils: equal where its moments are sound, better where sky and wings matter."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "imaging"))

from frames import gaussian_light
from spot_frames import EVEN, SHAPE, background, elliptic, frame_of, psf_camera

from namod_ctl.imaging.psf_image import measure_psf

pytest.importorskip("photutils", reason="photutils is not installed (extra 'peers')")

from photutils.aperture import CircularAnnulus
from photutils.background import Background2D, MedianBackground
from photutils.morphology import data_properties
from photutils.profiles import CurveOfGrowth
from photutils.segmentation import detect_sources

CAMERA = psf_camera()


def area_of(properties):
    return math.pi * math.sqrt(np.linalg.det(properties.covariance.value))


def test_moments_of_light_without_noise_are_the_same():
    """In a noiseless 16 bit image both simply add up light; data_properties keeps the pixels' own width of 1/12."""
    light = 20_000.0 * elliptic(150.2, 120.7, 10.0, 6.0, 0.4)
    frame = np.rint(light + 1000.0).astype(np.uint16)
    ours = measure_psf(frame, psf_camera(full_scale_adu=65535.0), 0.1)
    theirs = data_properties(frame.astype(float) - 1000.0)
    v_xx, v_xy, v_yy = ours.numbers[2:5]
    their_v = theirs.covariance.value - np.eye(2) / 12.0
    assert [[v_xx, v_xy], [v_xy, v_yy]] == pytest.approx(their_v, rel=2e-3)
    assert ours.numbers[:2] == pytest.approx(theirs.centroid, abs=1e-3)


def test_containment_is_that_of_the_curve_of_growth():
    light = 20_000.0 * elliptic(150.2, 120.7, 10.0, 6.0, 0.4)
    frame = np.rint(light + 1000.0).astype(np.uint16)
    ours = measure_psf(frame, psf_camera(full_scale_adu=65535.0), 0.1)
    growth = CurveOfGrowth(frame.astype(float) - 1000.0, (150.2, 120.7), np.arange(1.0, 70.0, 0.5))
    share = growth.profile / growth.profile[-1]
    theirs = [
        np.interp(contained, share, growth.radii if len(growth.radii) == len(share) else growth.radius)
        for contained in (0.39, 0.68, 0.80, 0.95)
    ]
    assert ours.numbers[5:] == pytest.approx(theirs, rel=0.01)


@pytest.mark.parametrize("sky", [EVEN, (10.0, 8.0, -5.0, 0.25)], ids=["even sky", "uneven sky"])
def test_no_worse_than_segments_of_photutils(sky):
    """Background2D and the moments of what stands 1.5 sigma above: the wings below are missing, the sky adds some."""
    true_px2 = math.pi * 9.0 * 7.0
    ours, theirs = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        frame = frame_of(120.0 * elliptic(150.0, 120.0, 9.0, 7.0, rng.uniform(0.0, math.pi)), rng, sky)
        ours.append(measure_psf(frame, CAMERA, 0.1).a_sigma_px2 / true_px2 - 1.0)
        found = Background2D(frame.astype(float), (60, 60), bkg_estimator=MedianBackground())
        data = frame - found.background
        segments = detect_sources(data, 1.5 * found.background_rms, n_pixels=50)
        brightest = max(segments.labels, key=lambda label: data[segments.data == label].sum())
        theirs.append(area_of(data_properties(data, mask=segments.data != brightest)) / true_px2 - 1.0)
    rms_ours, rms_theirs = (float(np.sqrt(np.mean(np.square(errors)))) for errors in (ours, theirs))
    assert rms_ours < 0.02
    assert rms_ours < rms_theirs


def test_background_agrees_with_an_annulus():
    """On an even sky the surface in the middle is the mean of photutils' annulus."""
    frame = frame_of(60.0 * gaussian_light(SHAPE, 150.0, 120.0, 7.0), np.random.default_rng(1))
    ours = measure_psf(frame, CAMERA, 0.1).background
    ring = CircularAnnulus((150.0, 120.0), 45.0, 90.0)
    level = ring.do_photometry(frame.astype(float))[0][0] / ring.area
    assert ours.coefficients[0] == pytest.approx(level, abs=0.05)
    assert background(SHAPE, *EVEN).mean() + 8.0 == pytest.approx(level, abs=0.05)
