"""The live estimate against the reconstruction that it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from response_maker import ARCMIN, instrument, make_run

from namod_ctl.core.errors import DataQualityError
from namod_ctl.cycle.live_estimate import RunningEstimate
from namod_ctl.reconstruction.reconstruct import reconstruct

N_FACETS = 20


def test_it_says_what_the_reconstruction_says() -> None:
    """While the run grows; within 20 %, as both estimate the factor of repetition from some hundred random pulls."""
    made, telescope = make_run(7, n_records=400, n_facets=N_FACETS), instrument(N_FACETS)
    running = RunningEstimate(telescope)
    for n in (150, 180, 400):
        table = made.table.select(np.arange(made.table.n_records) < n)
        estimate = running.of(table)
        if n in (180, 400):
            alignment = reconstruct(table, telescope).alignment
            facets = alignment.facets
            seen = {f.facet_id: np.linalg.eigvalsh(f.theta_cov_rad2)[-1] for f in facets if np.isfinite(f.theta_rad[0])}
            worst_rad = float(np.sqrt(max(seen.values())))
            assert estimate.n_records == n
            # the same light, whatever the halves say of its uncertainty
            assert estimate.a_sigma_rad2 == pytest.approx(alignment.now.a_sigma_rad2, rel=0.02)
            assert estimate.a_sigma_uncertainty_rad2 == pytest.approx(alignment.now.uncertainty_rad2, rel=0.3)
            assert estimate.worst_uncertainty_rad == pytest.approx(worst_rad, rel=0.2)
            assert set(estimate.unseen_facet_ids) == set(telescope.reflector.ids) - set(seen)


def test_facets_that_throw_no_light_are_named() -> None:
    made = make_run(8, n_records=300, n_facets=N_FACETS)
    response = made.table.response.copy()
    response[:, 3] = 0.0  # covered
    response[:, 5] = 3e-4 * np.abs(np.random.default_rng(1).normal(size=300))  # noise of an unlit facet
    table = replace(made.table, response=response)
    estimate = RunningEstimate(instrument(N_FACETS)).of(table)
    assert set(estimate.unseen_facet_ids) == {table.facet_ids[3], table.facet_ids[5]}
    assert 0.0 < estimate.worst_uncertainty_rad < 4.0 * ARCMIN


def test_too_few_records_say_nothing() -> None:
    made = make_run(9, n_records=5, n_facets=N_FACETS)
    with pytest.raises(DataQualityError):
        RunningEstimate(instrument(N_FACETS)).of(made.table)
