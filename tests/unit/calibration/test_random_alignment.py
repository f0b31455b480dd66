"""Scatter of tilts over the zenith distance: against the twin's own sag, and against laws put in by hand."""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.gravity.random_alignment import (
    fit_zenith_law,
    scatter_over_zenith,
    spread_of_run,
    spread_of_tilts,
)
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import ReflectorSettings
from namod_ctl.twin.surface_map import outline_m

FOUR_RUNS_RAD = deg_to_rad(np.array([10.0, 30.0, 45.0, 60.0]))
BETWEEN_RAD = deg_to_rad(np.arange(10.0, 61.0, 5.0))
NOISE_RAD = arcmin_to_rad(0.028)  # of a facet's tilt: the median that 400 records of the twin give


def fact_twin(settings: ReflectorSettings, seed: int) -> TwinReflector:
    instrument = build_instrument(load_config("fact"))
    outlines = [outline_m(facet) for facet in instrument.reflector.facets]
    return TwinReflector(instrument.reflector, instrument.mounts, outlines, settings, seed)


def tilts_at(settings: ReflectorSettings, seed: int, zenith_rad: float) -> np.ndarray:
    """True tilts of a twin that stands at a zenith distance, coming from its park position."""
    twin = fact_twin(settings, seed)
    twin.update(0.0, lambda _: zenith_rad)
    return twin.true_tilt_rad


def true_sigma_rad(tilt_rad: np.ndarray) -> np.ndarray:
    return tilt_rad.std(axis=0, ddof=1)


def run_of(tilt_rad: np.ndarray, noise_rad: np.ndarray, zenith_rad: float, rng: np.random.Generator) -> RunOfFacets:
    """A run that found these tilts, with noise; a facet is brightest at twice its tilt."""
    theta = 2.0 * (tilt_rad + noise_rad * rng.standard_normal(tilt_rad.shape))
    cov = 4.0 * noise_rad[:, :, None] ** 2 * np.eye(2)
    return RunOfFacets(
        f"{np.degrees(zenith_rad):.0f}", ZenithPath(np.array([zenith_rad])), theta, cov, np.ones((30, 1))
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("aligned_at_deg", [None, 30.0])
def test_the_law_gives_the_twins_scatter_within_ten_percent(seed: int, aligned_at_deg: float | None) -> None:
    """From four runs with noise; as found, and after an alignment at 30 deg that left 0.1 arcmin."""
    settings = ReflectorSettings(sag_rad=arcmin_to_rad(0.8), misalignment_rad=arcmin_to_rad(1.5))
    rng = np.random.default_rng(seed)
    correction = np.zeros((30, 2))
    if aligned_at_deg is not None:
        left = arcmin_to_rad(0.1) * rng.standard_normal((30, 2))
        correction = left - tilts_at(settings, seed, deg_to_rad(aligned_at_deg))
    noise = NOISE_RAD * rng.uniform(0.5, 1.5, (30, 2))
    runs = [run_of(tilts_at(settings, seed, zenith) + correction, noise, zenith, rng) for zenith in FOUR_RUNS_RAD]
    scatter = scatter_over_zenith(runs, np.ones(30))
    expected = np.array([true_sigma_rad(tilts_at(settings, seed, zenith) + correction) for zenith in BETWEEN_RAD])
    # where the scatter left over is hardly larger than the estimates' noise, it is known no better than this
    unsure = np.max([spread.sigma_uncertainty_rad / spread.sigma_rad for spread in scatter.at_runs], axis=0)
    for axis in (0, 1):
        tolerance = 0.1 if aligned_at_deg is None else max(0.1, 2.5 * unsure[axis])
        assert tolerance < 0.2
        found = scatter.laws[axis].sigma_rad(BETWEEN_RAD)
        np.testing.assert_allclose(found, expected[:, axis], rtol=tolerance)


def test_the_noise_of_the_estimates_is_taken_off() -> None:
    """Tilts that scatter as much as their noise: on average, over 400 telescopes, the truth, with its uncertainty."""
    rng = np.random.default_rng(5)
    noise = np.tile([0.5, 1.0, 2.0], 10)[:, None] * np.ones(2)  # facets are not equally well known
    tilts = rng.standard_normal((400, 30, 2))
    tilts /= tilts.std(axis=1, ddof=1, keepdims=True)  # the same scatter, 1, in every telescope
    spreads = [spread_of_tilts(tilt + noise * rng.standard_normal((30, 2)), noise**2) for tilt in tilts]
    variances = np.array([spread.variance_rad2 for spread in spreads]).ravel()
    stated = np.array([spread.uncertainty_rad2 for spread in spreads]).ravel()
    assert variances.mean() == pytest.approx(1.0, abs=4 * variances.std() / np.sqrt(len(variances)))
    assert np.sqrt((stated**2).mean()) == pytest.approx(variances.std(), rel=0.1)


def test_a_common_tilt_is_pointing_not_scatter() -> None:
    tilts = 1e-4 * np.random.default_rng(2).standard_normal((30, 2))
    one, other = (spread_of_tilts(tilts + common, np.zeros((30, 2))) for common in (0.0, 0.01))
    np.testing.assert_allclose(one.variance_rad2, other.variance_rad2)


def law_by_hand(zenith_rad: np.ndarray, constant: float, z0_deg: float, cosine: float, sine: float) -> np.ndarray:
    z0 = np.radians(z0_deg)
    c, s = np.cos(zenith_rad) - np.cos(z0), np.sin(zenith_rad) - np.sin(z0)
    return constant**2 + cosine**2 * c**2 + sine**2 * s**2


@pytest.mark.parametrize(
    ("parameters", "terms"),
    [
        ((0.0034, 28.0, 0.01, 0.0), ("cos",)),  # the defaults of mirror_align_random_vertical, gammasimtools 0.38
        ((0.0035, 28.0, 0.023, 0.0), ("cos",)),  # and of mirror_align_random_horizontal
        ((0.002, 40.0, 0.03, 0.02), ("sin", "cos")),
        ((0.002, -10.0, 0.0, 0.02), ("sin",)),
        ((0.002, 0.0, 0.0, 0.0), ()),
    ],
)
def test_laws_of_sim_telarrays_form_come_back(parameters: tuple[float, ...], terms: tuple[str, ...]) -> None:
    zenith = np.radians(np.arange(0.0, 66.0, 2.0))
    variance = law_by_hand(zenith, *parameters)
    law = fit_zenith_law(zenith, variance, 0.01 * variance, terms)
    found = (law.constant_rad, np.degrees(law.z0_rad), law.cosine_rad, law.sine_rad)
    np.testing.assert_allclose(found, parameters, rtol=0.02, atol=1e-6)


def test_a_stiff_telescope_gets_no_zenith_terms() -> None:
    rng = np.random.default_rng(8)
    tilts, noise = 2e-4 * rng.standard_normal((30, 2)), np.full((30, 2), NOISE_RAD)
    for _ in range(20):
        scatter = scatter_over_zenith([run_of(tilts, noise, zenith, rng) for zenith in FOUR_RUNS_RAD], np.ones(30))
        assert all(law.cosine_rad == law.sine_rad == 0.0 for law in scatter.laws)
        sigma = [law.constant_rad for law in scatter.laws]
        np.testing.assert_allclose(sigma, true_sigma_rad(tilts), rtol=0.05)


def test_stated_uncertainties_of_sigma_hold() -> None:
    """Over 100 repetitions of four runs of one twin."""
    settings = ReflectorSettings(sag_rad=arcmin_to_rad(0.8), misalignment_rad=arcmin_to_rad(0.3))
    truth = [tilts_at(settings, 4, zenith) for zenith in FOUR_RUNS_RAD]
    expected = np.array([true_sigma_rad(tilts) for tilts in truth])
    rng, noise = np.random.default_rng(9), np.full((30, 2), 2.0 * NOISE_RAD)
    pulls = []
    for _ in range(100):
        runs = [run_of(tilts, noise, zenith, rng) for tilts, zenith in zip(truth, FOUR_RUNS_RAD, strict=True)]
        at_runs = scatter_over_zenith(runs, np.ones(30)).at_runs
        sigma = np.array([spread.sigma_rad for spread in at_runs])
        pulls.append((sigma - expected) / np.array([spread.sigma_uncertainty_rad for spread in at_runs]))
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.2)
    assert abs(np.mean(pulls)) < 0.3


def test_one_run_is_its_own_scatter() -> None:
    rng = np.random.default_rng(3)
    tilts = 3e-4 * rng.standard_normal((30, 2))
    run = run_of(tilts, np.full((30, 2), NOISE_RAD), 0.5, rng)
    np.testing.assert_allclose(spread_of_run(run).sigma_rad, true_sigma_rad(tilts), rtol=0.05)


def test_noise_that_explains_everything_leaves_zero_with_an_uncertainty() -> None:
    rng = np.random.default_rng(1)
    run = run_of(np.zeros((30, 2)), np.full((30, 2), NOISE_RAD), 0.5, rng)
    spread = spread_of_run(run)
    assert np.all(spread.sigma_rad < NOISE_RAD / 2)
    assert np.all(spread.sigma_uncertainty_rad > NOISE_RAD / 10)


def test_too_few_facets_and_too_few_runs_are_refused() -> None:
    with pytest.raises(DataQualityError, match="only 2 facets"):
        spread_of_tilts(np.zeros((2, 2)), np.zeros((2, 2)))
    rng = np.random.default_rng(1)
    runs = [run_of(np.zeros((30, 2)), np.full((30, 2), NOISE_RAD), zenith, rng) for zenith in FOUR_RUNS_RAD[:2]]
    with pytest.raises(DataQualityError, match="at least 3"):
        scatter_over_zenith(runs, np.ones(30))
