"""The radiometric law: the paper's coefficients, and its purpose, that an intensity does not know the exposure."""

import math
from dataclasses import replace

import numpy as np
import pytest
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, resized

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.radiometry import checked_frame, exposure_factor, grey_frame, response_table


@pytest.mark.parametrize(
    ("camera", "response", "exposure_s", "log10_intensity"),
    [
        # By hand from arXiv:1605.06274: log10(I) = r_resp log10(C) + r_expo log10(T) + r_const.
        (STAR_CAMERA, 255, 1.0, 0.99),
        (STAR_CAMERA, 51, 0.1, 1.20 * math.log10(0.2) + 1.23 + 0.99),
        (REFLECTOR_CAMERA, 255, 1.0, -0.19),
        (REFLECTOR_CAMERA, 51, 0.01, 1.03 * math.log10(0.2) + 2.30 - 0.19),
    ],
)
def test_published_coefficients(camera, response, exposure_s, log10_intensity):
    intensity = response_table(camera, np.dtype(np.uint8))[response] * exposure_factor(camera.law, exposure_s)
    assert math.log10(intensity) == pytest.approx(log10_intensity, abs=1e-12)


def test_no_response_is_no_intensity():
    assert response_table(STAR_CAMERA, np.dtype(np.uint8))[0] == 0.0


@pytest.mark.parametrize("camera", [STAR_CAMERA, REFLECTOR_CAMERA])
def test_one_scene_has_one_intensity_at_every_exposure(camera):
    """Responses come from intensities by the law solved for C; rounding to 12 bit leaves 1e-3 at the faintest pixel."""
    law = camera.law
    exposures_s = (0.05, 0.07)
    faint = 10.0 ** (law.r_resp * math.log10(0.2) + law.r_expo * math.log10(exposures_s[0]) + law.r_const)
    scene = faint * np.linspace(1.0, 2.5, 40)
    table = response_table(replace(camera, full_scale_adu=4095.0), np.dtype(np.uint16))
    for exposure_s in exposures_s:
        share = 10.0 ** ((np.log10(scene) - law.r_expo * math.log10(exposure_s) - law.r_const) / law.r_resp)
        assert share.max() < 1.0
        measured = table[np.rint(4095.0 * share).astype(np.uint16)] * exposure_factor(law, exposure_s)
        np.testing.assert_allclose(measured, scene, rtol=1e-3)


def test_responses_above_full_scale_count_as_full_scale():
    table = response_table(replace(STAR_CAMERA, full_scale_adu=4095.0), np.dtype(np.uint16))
    assert table.shape == (65536,)
    assert table[65535] == table[4095] == 1.0


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_exposure_is_refused(exposure_s):
    with pytest.raises(ConfigError, match="exposure"):
        exposure_factor(STAR_CAMERA.law, exposure_s)


def test_grey_of_copied_channels_is_the_grey_frame():
    grey = np.random.default_rng(3).integers(0, 256, (20, 30)).astype(np.uint8)
    np.testing.assert_array_equal(grey_frame(np.repeat(grey[:, :, None], 3, axis=2), 250.0), grey)


def test_one_saturated_channel_saturates_the_grey_pixel():
    frame = np.array([[[255, 10, 10], [100, 110, 120]]], dtype=np.uint8)
    np.testing.assert_array_equal(grey_frame(frame, 250.0), [[255, 110]])


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (np.zeros((12, 10), np.uint8), "12, 10"),
        (np.zeros((10, 12, 4), np.uint8), "channels"),
        (np.zeros((10, 12)), "float64"),
        (np.zeros(120, np.uint8), "120"),
    ],
)
def test_a_frame_of_another_camera_is_refused(frame, text):
    with pytest.raises(ConfigError, match=text):
        checked_frame(frame, resized(STAR_CAMERA, 12, 10))


def test_full_scale_beyond_the_frame_is_refused():
    with pytest.raises(ConfigError, match="full_scale_adu = 4095"):
        checked_frame(np.zeros((10, 12), np.uint8), replace(resized(STAR_CAMERA, 12, 10), full_scale_adu=4095.0))


def test_a_single_channel_in_three_dimensions_is_grey():
    assert checked_frame(np.zeros((10, 12, 1), np.uint8), resized(STAR_CAMERA, 12, 10)).shape == (10, 12)
