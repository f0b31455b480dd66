"""Digital numbers against the radiometric law in closed form.

log10(I) = r_resp log10(C) + r_expo log10(T) + r_const
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.sensor import NORMAL_QUANTILES, Sensor
from namod_ctl.twin.settings import STAR_CAMERA, CameraSettings

PAPER = {"star": (1.20, -1.23, 0.99), "reflector": (1.03, -1.15, -0.19)}
"""arXiv:1605.06274, section 3."""


def sensor(law: tuple[float, float, float] = PAPER["star"], settings: CameraSettings = STAR_CAMERA) -> Sensor:
    camera = CameraModel(
        "test", 200, 150, 1e-4, np.array([100.0, 75.0]), False, CameraOrientation(), RadiometricLaw(*law)
    )
    return Sensor(camera, settings, "star", seed=1)


@pytest.mark.parametrize("law", PAPER.values(), ids=PAPER.keys())
@pytest.mark.parametrize("exposure_s", [1e-3, 0.04, 3.0])
def test_the_law_recovers_the_intensity(law: tuple[float, float, float], exposure_s: float) -> None:
    r_resp, r_expo, r_const = law
    response_share = np.linspace(0.02, 0.99, 20)
    intensity = 10.0 ** (r_resp * np.log10(response_share) + r_expo * np.log10(exposure_s) + r_const)
    made = sensor(law).response(intensity, exposure_s) / 255.0
    np.testing.assert_allclose(made, response_share, rtol=1e-9)


def test_mean_and_noise_of_pixels_are_as_asked() -> None:
    s = sensor(settings=replace(STAR_CAMERA, read_noise_adu=0.8, electrons_per_adu=20.0))
    normal = np.random.default_rng(2).standard_normal(200_000)
    for mean in (5.0, 50.0, 200.3):
        adu = s.digitized(np.full(normal.size, mean), normal).astype(float)
        assert adu.mean() == pytest.approx(mean, abs=0.03)
        expected = np.sqrt(0.8**2 + mean / 20.0 + 1.0 / 12.0)  # 1/12: rounding to whole numbers
        assert adu.std() == pytest.approx(expected, rel=0.02)


def test_the_quantiles_of_the_sky_have_its_mean_and_noise() -> None:
    assert NORMAL_QUANTILES.std() == pytest.approx(1.0)
    s = sensor(settings=replace(STAR_CAMERA, read_noise_adu=1.5))
    table = s.quantile_tables(np.array([7.4]))[0].astype(float)
    assert table.mean() == pytest.approx(7.4, abs=0.05)
    assert table.std() == pytest.approx(np.sqrt(1.5**2 + 7.4 / 40.0 + 1.0 / 12.0), rel=0.05)


def test_an_imperfect_calibration_errs_by_the_wanted_amount_per_decade() -> None:
    """At constant response: a star ten times fainter is exposed longer, and comes out 17.2 % per decade too faint."""
    r_resp, r_expo, r_const = PAPER["reflector"]
    s = sensor(PAPER["reflector"], replace(STAR_CAMERA, law_error_per_decade=0.172))
    recovered = []
    intensities = np.array([1.0, 10.0])
    for intensity in intensities:
        exposures = np.geomspace(1e-4, 10.0, 200_001)
        made = np.array([s.response_factor(e) for e in exposures[::100]]) * intensity ** (1.0 / r_resp)
        exposure_s = float(np.interp(np.log(200.0), np.log(made), np.log(exposures[::100])))
        recovered.append(10.0 ** (r_resp * np.log10(200.0 / 255.0) + r_expo * exposure_s / np.log(10.0) + r_const))
    ratio = (recovered[1] / recovered[0]) / (intensities[1] / intensities[0])
    assert ratio == pytest.approx(1.172, rel=1e-3)


def test_hot_pixels_grow_with_exposure_and_stay_where_they_are() -> None:
    s = sensor()
    short, long = np.zeros((150, 200), np.uint8), np.zeros((150, 200), np.uint8)
    s.shine_hot(short, 0.1, [])
    s.shine_hot(long, 1.0, [])
    assert np.count_nonzero(long) >= 0.9 * STAR_CAMERA.n_hot_pixels
    assert set(np.flatnonzero(short)) <= set(np.flatnonzero(long))
    assert short.astype(int).sum() < 0.3 * long.astype(int).sum()


def test_too_much_light_spills_along_its_column() -> None:
    mean = np.zeros((150, 200))
    mean[70:80, 100] = 255.0 * 40.0
    spilled = sensor().bloomed(mean)
    full = np.flatnonzero(spilled[:, 100] >= 255.0)
    assert full.size == pytest.approx(10 + 0.1 * 10 * 39, abs=2)
    assert abs(full.mean() - 74.5) < 1.0
    assert not np.delete(spilled, 100, axis=1).any()
    weak = np.full((150, 200), 250.0)
    np.testing.assert_array_equal(sensor().bloomed(weak), weak)
