"""The slope of responses over the star's brightness: found where it is, not invented where it is not, and removed.

Runs are made by throwing rays (`response_maker`), stars fade by `star_maker`; the truth is what was put in. The figures
over many seeds are those of benchmarks/bench_normalization.py.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from response_maker import ARCMIN, DEG, disc, instrument, make_run
from star_maker import stars, under_star

from namod_ctl.reconstruction.facet_fit import centre_covariance
from namod_ctl.reconstruction.facet_psf import CENTRE
from namod_ctl.reconstruction.normalization import (
    PER_MAGNITUDE,
    measure_at_rest,
    measure_normalization,
    without_slope,
)
from namod_ctl.reconstruction.reconstruct import fit_run
from namod_ctl.reconstruction.responses import ResponseTable

PAPER_PER_MAGNITUDE = -0.069  # arXiv:1605.06274, section 3
EXPONENT = math.log(1.0 + PAPER_PER_MAGNITUDE) / math.log(10.0 ** (-0.4))
N_FACETS = 12
TELESCOPE = instrument(N_FACETS)


def wandering(seed=1, n_records=300):
    """An aligned mirror, a small region: the same facets are lit again and again."""
    return make_run(seed, n_records, N_FACETS, path=lambda rng, n: disc(rng, n, 0.12 * DEG), misalignment_rad=ARCMIN)


def at_rest(rng, magnitude, exponent=0.0, noise=0.01, n_facets=12):
    """The table of a lamp of these magnitudes, (n,), which lights all facets."""
    n = len(magnitude)
    response = rng.uniform(0.6, 1.2, n_facets) * 10.0 ** (-0.4 * exponent * magnitude[:, None])
    response = response * np.exp(noise * rng.normal(size=(n, n_facets)))
    faintness = 10.0 ** (0.4 * (magnitude - np.median(magnitude))) * np.exp(noise * rng.normal(size=n))
    ids = tuple(range(1, n_facets + 1))
    return ResponseTable(ids, np.arange(n), np.zeros((n, 2)), np.full(n, np.nan), response, faintness)


@pytest.fixture(scope="module")
def made():
    return wandering()


@pytest.fixture(scope="module")
def changed(made):
    """Runs on three stars with and without the paper's slope, otherwise alike."""
    return {
        exponent: under_star(made, np.random.default_rng(5), stars(None, 300, (0.0, 2.3, 1.2)), exponent)
        for exponent in (0.0, EXPONENT)
    }


@pytest.fixture(scope="module")
def sloped(changed):
    return {is_on: fit_run(changed[EXPONENT].table, TELESCOPE, self_calibration=is_on) for is_on in (True, False)}


@pytest.mark.parametrize("exponent", [0.0, EXPONENT, -0.2])
@pytest.mark.parametrize("levels", ["steps", "jumps"])
def test_a_lamp_shows_the_slope_to_a_tenth_of_a_per_cent(levels, exponent):
    """Ten records per step and noise of 1 %; and the same levels in random order, one record each."""
    rng = np.random.default_rng(3)
    magnitude = np.repeat(np.linspace(0.0, 5.0, 8), 10)
    if levels == "jumps":
        magnitude = rng.permutation(magnitude)
    found = measure_at_rest(at_rest(rng, magnitude, exponent))
    assert found.is_known
    assert found.range_mag == pytest.approx(5.0, abs=0.3)
    assert 100.0 * found.per_magnitude == pytest.approx(100.0 * (10.0 ** (-0.4 * exponent) - 1.0), abs=0.3)
    assert found.per_magnitude_uncertainty < 0.002


def test_scintillation_of_a_bright_star_is_no_slope():
    """A bright star is exposed shortly and scintillates more; its mean is kept, so the mean of its log falls.

    Young's formula: variance goes as one over the exposure. Here 25 % at 0 mag, so half its variance are 3 % of light,
    and 0.3 % at 2.5 mag: a mean of logs would have an exponent of 0.012.
    """
    rng = np.random.default_rng(12)
    errors = []
    for _ in range(6):
        magnitude = 1.25 - 1.25 * np.cos(2.0 * np.pi * np.arange(2000) / 200.0)
        table = at_rest(rng, magnitude)
        sigma = 0.25 * 10.0 ** (-0.2 * magnitude)
        factor = np.exp(sigma * rng.normal(size=2000) - sigma**2 / 2.0)
        found = measure_at_rest(
            replace(table, response=table.response / factor[:, None], faintness=table.faintness / factor)
        )
        errors.append((found.exponent, found.exponent_uncertainty))
    exponent, uncertainty = np.array(errors).T
    assert uncertainty.max() < 0.008
    assert abs(exponent.mean()) < 0.006
    assert np.sqrt(np.mean((exponent / uncertainty) ** 2)) < 2.0


def test_slopes_per_magnitude_and_per_decade_are_one_power_law():
    """Two and a half magnitudes are a decade; the paper's -6.9 % per magnitude are then +19.6 % per decade."""
    found = measure_at_rest(at_rest(np.random.default_rng(4), np.repeat(np.linspace(0, 5, 8), 10), EXPONENT))
    assert 1.0 + found.per_decade == pytest.approx((1.0 + found.per_magnitude) ** -2.5)
    assert found.per_decade == pytest.approx(0.196, abs=0.01)
    assert found.is_significant


def test_the_paper_s_slope_is_found_in_a_run_and_taken_out(sloped):
    found = sloped[True].normalization
    assert found.is_significant
    assert abs(found.exponent - EXPONENT) < 3.0 * found.exponent_uncertainty
    left = math.expm1(PER_MAGNITUDE * (EXPONENT - sloped[True].removed_exponent))
    assert abs(left) < max(0.01, 2.5 * found.per_magnitude_uncertainty)
    assert found.per_magnitude_uncertainty < 0.015
    assert sloped[False].removed_exponent == 0.0


def test_what_is_taken_out_is_not_found_again(sloped):
    again = measure_normalization(sloped[True].used, sloped[True].fits)
    assert abs(again.per_magnitude) < 0.005


def test_centres_stay_within_their_uncertainty(sloped, made):
    """And come no further from the truth than chance takes them, 10 %: their moves are a third of their errors."""
    on, off = (
        np.array([fit.parameters[CENTRE] for fit in sloped[is_on].fits if fit is not None]) for is_on in (True, False)
    )
    sigma = np.sqrt([np.trace(centre_covariance(fit)) for fit in sloped[True].fits if fit is not None])
    moved = np.linalg.norm(on - off, axis=1)
    assert np.sqrt(np.mean((moved / sigma) ** 2)) < 1.0
    error_on, error_off = (np.sqrt(np.mean((theta - made.centre_rad) ** 2)) for theta in (on, off))
    assert error_on < 1.1 * error_off


def test_a_good_calibration_is_left_as_it_is(changed):
    fitted = fit_run(changed[0.0].table, TELESCOPE)
    found = fitted.normalization
    assert found.is_known
    assert abs(found.exponent) < 3.0 * found.exponent_uncertainty
    assert fitted.removed_exponent == 0.0


def test_noise_of_a_steady_star_is_no_slope(made):
    """The star's noise divides the responses: a plain fit over the measured intensities has a slope of -1."""
    run = under_star(made, np.random.default_rng(6), np.zeros(300))
    fitted = fit_run(run.table, TELESCOPE)
    assert not fitted.normalization.is_known
    assert "mag only" in fitted.normalization.doubt
    assert fitted.removed_exponent == 0.0


def test_a_star_that_fades_while_the_telescope_moves_on_says_little(sloped):
    """Bright in one half of the region and faint in the other: no facet can tell that from its own shape and flux."""
    made = wandering(3)
    side = np.argsort(made.table.theta_rad[:, 0])
    made = made.select(side)
    magnitude = np.where(made.table.theta_rad[:, 0] < 0.0, 0.0, 2.5)
    crossed = under_star(made, np.random.default_rng(7), magnitude, EXPONENT)
    found = fit_run(crossed.table, TELESCOPE, self_calibration=False).normalization
    easy = sloped[False].normalization
    assert found.exponent_uncertainty > 1.5 * easy.exponent_uncertainty
    assert abs(found.exponent - EXPONENT) < 3.0 * found.exponent_uncertainty


@pytest.mark.parametrize("kept", [1, 2])
def test_too_few_facets_say_nothing(kept):
    table = at_rest(np.random.default_rng(8), np.repeat(np.linspace(0, 5, 8), 10))
    dark = np.where(np.arange(12) < kept, 1.0, 1e-4)
    found = measure_at_rest(replace(table, response=table.response * dark))
    assert not found.is_known
    assert f"{kept} facets" in found.doubt


def test_records_without_intensities_say_nothing(made):
    found = fit_run(made.table.select(np.arange(120)), TELESCOPE).normalization
    assert not found.is_known
    assert "response maps" in found.doubt


def test_the_typical_record_is_not_changed():
    table = at_rest(np.random.default_rng(9), np.repeat([-1.0, 0.0, 1.0], 9), EXPONENT, noise=0.0)
    flat = without_slope(table, EXPONENT).response
    assert flat[9:18] == pytest.approx(table.response[9:18])
    assert flat[0] == pytest.approx(flat[-1])
