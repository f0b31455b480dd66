"""Runs that went wrong once, or still do; each is the smallest one that shows the defect."""

from __future__ import annotations

import numpy as np
import pytest
from response_maker import ARCMIN, DEG, instrument, make_run

from namod_ctl.core.errors import DataQualityError
from namod_ctl.reconstruction.reconstruct import reconstruct

DISH = instrument()


def trusted_errors_arcmin(run):
    """Distances from the truth of the facets on which somebody would turn bolts."""
    facets = reconstruct(run.table, DISH).alignment.facets
    found = [
        (facet.theta_rad, run.centre_rad[facet.facet_id - 1]) for facet in facets if not facet.flags.forbids_turning
    ]
    return np.array([np.linalg.norm(theta - centre) for theta, centre in found]) / ARCMIN


def test_all_records_at_one_place_are_refused():
    run = make_run(0, 100, n_facets=5)
    with pytest.raises(DataQualityError):
        reconstruct(run.with_theta(np.full((100, 2), 1e-3)).table, DISH)


def test_records_on_a_line_are_refused():
    def line(rng, n):
        return np.stack([np.linspace(-0.35, 0.35, n) * DEG, np.zeros(n)], axis=1)

    with pytest.raises(DataQualityError):
        reconstruct(make_run(0, 200, n_facets=5, path=line).table, DISH)


def test_a_scan_beside_the_reflectors_light_moves_nobody():
    """Every facet shines more than a degree away: nothing but dark noise was recorded."""
    run = make_run(0, 300, centres_rad=np.random.default_rng(1).normal(DEG, 4 * ARCMIN, (12, 2)))
    try:
        errors = trusted_errors_arcmin(run)
    except DataQualityError:
        return
    assert len(errors) == 0


def test_most_facets_out_of_the_scan():
    """Two of twelve facets within the scan: these may be trusted (two are no family), on the others nobody turns."""
    centres = np.random.default_rng(1).normal(DEG, 4 * ARCMIN, (12, 2))
    centres[:2] -= DEG
    errors = trusted_errors_arcmin(make_run(0, 600, centres_rad=centres))
    assert len(errors) <= 2
    assert np.all(errors < 1.0)


def test_flashes_on_single_facets():
    """One response in a hundred is a flash of one to ten times the facet's peak, alone in its record."""
    run = make_run(0, n_facets=8)
    rng = np.random.default_rng(5)
    response = run.table.response.copy()
    flash = rng.random(response.shape) < 0.01
    response[flash] = rng.uniform(0.3, 3.0, int(flash.sum()))
    errors = trusted_errors_arcmin(run.with_response(response))
    assert len(errors) > 5
    assert np.sqrt(np.mean(errors**2)) < 0.3


def test_backgrounds_with_gradients_accuse_no_record():
    """A background of up to 3 % of full light that changes by up to 70 % over the scan, different on each facet."""
    run = make_run(0, n_facets=8)
    rng = np.random.default_rng(5)
    slope = 1 + 0.7 * run.table.theta_rad @ rng.uniform(-1, 1, (2, 8)) / (0.35 * DEG)
    hazy = run.with_response(run.table.response + rng.uniform(0, 0.03, 8) * slope)
    alignment = reconstruct(hazy.table, DISH).alignment
    assert alignment.bad_records == ()
    found = np.array([facet.theta_rad for facet in alignment.facets])
    assert np.sqrt(np.mean((found - run.centre_rad) ** 2)) < 0.15 * ARCMIN


@pytest.mark.xfail(reason="misfit of the shape model is correlated over records, so neither factor sees it")
def test_wide_and_odd_psfs_state_their_errors():
    """Figure errors three times those of FACT: PSFs of many lobes, which the shape terms follow only roughly."""
    run = make_run(1, n_facets=8, figure=3.0)
    facets = reconstruct(run.table, DISH).alignment.facets
    pulls = np.array(
        [
            np.linalg.solve(np.linalg.cholesky(facet.theta_cov_rad2), facet.theta_rad - centre)
            for facet, centre in zip(facets, run.centre_rad, strict=True)
        ]
    )
    assert np.quantile(np.abs(pulls), 0.683) < 1.5


def test_darkness_without_noise_does_no_harm():
    """Unlit responses of exactly zero, as after a threshold: the fit must not become worse than with noise."""
    noisy, quiet = make_run(0, n_facets=6), make_run(0, n_facets=6, dark=0.0)
    rms = [np.sqrt(np.mean(trusted_errors_arcmin(run) ** 2)) for run in (noisy, quiet)]
    assert rms[1] < 2.0 * max(rms[0], 0.05)


def test_a_short_clean_run_has_no_bad_records():
    run = make_run(0, 60, n_facets=20)
    assert len(reconstruct(run.table, DISH).alignment.bad_records) <= 1


@pytest.mark.parametrize("n_records", [10, 20, 30])
def test_hardly_any_records(n_records):
    """Estimates that miss by more than two widths must not be given as trustworthy."""
    try:
        errors = trusted_errors_arcmin(make_run(0, n_records, n_facets=12))
    except DataQualityError:
        return
    assert np.count_nonzero(errors > 3.0) <= 1
