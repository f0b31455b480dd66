"""Bad records are found, named and left out; good ones are left alone.

A narrow scan of a well aligned reflector, so that many facets light up at once: two can not outvote a star.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from response_maker import ARCMIN, DEG, disc, instrument, make_run

from namod_ctl.reconstruction.reconstruct import reconstruct

DISH = instrument()
N_BAD = 12
N_RECORDS = 250


@cache
def clean():
    """A run, and records that light many facets: every second of the best."""
    run = make_run(11, N_RECORDS, n_facets=12, path=partial(disc, radius_rad=0.15 * DEG), misalignment_rad=1.5 * ARCMIN)
    n_lit = (run.light > 0.05).sum(axis=1)
    chosen = np.argsort(-n_lit, kind="stable")[: 2 * N_BAD : 2]
    assert n_lit[chosen].min() >= 5
    return run, np.sort(chosen)


def kinds(alignment):
    return {record.index - 1: record.kind for record in alignment.bad_records}  # records are numbered from 1


def rms_arcmin(alignment, run):
    found = np.array([facet.theta_rad for facet in alignment.facets])
    return np.sqrt(np.mean((found - run.centre_rad) ** 2)) / ARCMIN


def test_no_false_alarm():
    run, _ = clean()
    alignment = reconstruct(run.table, DISH).alignment
    assert alignment.bad_records == ()
    assert alignment.n_used == alignment.n_records == N_RECORDS


def test_wrong_stars_are_named_with_both_places():
    """Directions 9 arcmin off, six widths: the facets that light up tell where the star really stood."""
    run, chosen = clean()
    theta = run.table.theta_rad.copy()
    true_theta = theta[chosen].copy()
    theta[chosen] -= 9 * ARCMIN * true_theta / np.linalg.norm(true_theta, axis=1)[:, None]
    alignment = reconstruct(run.with_theta(theta).table, DISH).alignment
    found = kinds(alignment)
    assert set(found) <= set(chosen.tolist()), "good records were accused"
    assert len(found) >= N_BAD - 2
    assert set(found.values()) == {"wrong_star"}
    record = alignment.bad_records[0]
    seen = theta[record.index - 1] / DEG
    assert f"({seen[0]:+.3f}, {seen[1]:+.3f})" in record.detail
    named = record.detail.split("belong to (")[1].split(")")[0]
    told = np.array([float(part) for part in named.split(",")])
    true = true_theta[chosen.tolist().index(record.index - 1)] / DEG
    np.testing.assert_allclose(told, true, atol=2 * 1.5 / 60)  # a grid of one width, 1.5 arcmin
    assert record.facet_ids
    assert alignment.n_used == N_RECORDS - len(found)
    assert rms_arcmin(alignment, run) < 0.3


def test_stray_light_is_found():
    """Half a facet's peak on every facet at once, as no star can."""
    run, chosen = clean()
    response = run.table.response.copy()
    response[chosen] += 0.5 * response.max(axis=0).mean()
    alignment = reconstruct(run.with_response(response).table, DISH).alignment
    assert kinds(alignment) == dict.fromkeys(chosen.tolist(), "stray_light")
    assert rms_arcmin(alignment, run) < 0.3


@pytest.mark.parametrize("factor", [0.08, 12.0])
def test_a_clouds_edge_is_found(factor):
    """The star camera saw another transparency than the reflector camera."""
    run, chosen = clean()
    response = run.table.response.copy()
    response[chosen] *= factor
    alignment = reconstruct(run.with_response(response).table, DISH).alignment
    found = kinds(alignment)
    assert set(found) <= set(chosen.tolist()), "good records were accused"
    assert len(found) >= N_BAD - 2
    assert list(found.values()).count("cloud_edge") >= N_BAD - 3
    detail = next(record.detail for record in alignment.bad_records if record.kind == "cloud_edge")
    told = float(detail.split("all facets ")[1].split(" times")[0])
    assert 0.5 < told / factor < 2.0  # factors are tried in steps of 1.5
    assert rms_arcmin(alignment, run) < 0.3


def test_a_facet_whose_brightest_record_is_bad_is_named():
    run, chosen = clean()
    response = run.table.response.copy()
    response[chosen[0]] = 3.0 * response.max(axis=0)
    table = run.with_response(response).table
    alignment = reconstruct(table, DISH, "brightest").alignment
    assert [record.index for record in alignment.bad_records] == [chosen[0] + 1]
    assert all("RESTS_ON_BAD_RECORD" in facet.flags.names for facet in alignment.facets)
    named = [line for line in alignment.remarks if "single brightest record" in line]
    assert len(named) == 12
    assert f"number {chosen[0] + 1} " in named[0]


def test_two_facets_accuse_nobody():
    """Two witnesses can not outvote a star position."""
    run = make_run(11, 300, n_facets=2)
    theta = run.table.theta_rad.copy()
    theta[np.argsort(-run.light.sum(axis=1))[:3]] += 0.2 * DEG
    assert reconstruct(run.with_theta(theta).table, DISH).alignment.bad_records == ()
