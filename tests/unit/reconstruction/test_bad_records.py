"""Bad records are found, named and left out; good ones are left alone.

A narrow scan of a well aligned reflector, so that many facets light up at once: two can not outvote a star.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from response_maker import ARCMIN, DEG, disc, instrument, make_run

from namod_ctl.reconstruction.reconstruct import reconstruct

DISH = instrument()
N_RECORDS = 250
SHIFT_RAD = 9 * ARCMIN  # six widths
DIMMED, BRIGHTENED = 0.08, 12.0


@pytest.fixture(scope="module")
def clean():
    return make_run(
        11, N_RECORDS, n_facets=12, path=partial(disc, radius_rad=0.15 * DEG), misalignment_rad=1.5 * ARCMIN
    )


@pytest.fixture(scope="module")
def chosen(clean):
    """Rows of 16 records that light many facets: 5 for wrong stars, 5 for stray light, 3 and 3 for a cloud's edge."""
    n_lit = (clean.light > 0.05).sum(axis=1)
    rows = np.argsort(-n_lit, kind="stable")[:32:2]
    assert n_lit[rows].min() >= 5
    rows = np.random.default_rng(3).permutation(rows)
    return rows[:5], rows[5:10], rows[10:13], rows[13:]


@pytest.fixture(scope="module")
def spoiled(clean, chosen):
    """The run with its bad records, its reconstruction, and the kinds found by row."""
    wrong, stray, dimmed, brightened = chosen
    theta, response = clean.table.theta_rad.copy(), clean.table.response.copy()
    theta[wrong] -= SHIFT_RAD * theta[wrong] / np.linalg.norm(theta[wrong], axis=1)[:, None]
    response[stray] += 0.5 * response.max(axis=0).mean()  # half a facet's peak, on all facets at once
    response[dimmed] *= DIMMED
    response[brightened] *= BRIGHTENED
    run = clean.with_theta(theta).with_response(response)
    alignment = reconstruct(run.table, DISH).alignment
    return run, alignment, {record.index - 1: record for record in alignment.bad_records}


def test_no_false_alarm(clean):
    alignment = reconstruct(clean.table, DISH).alignment
    assert alignment.bad_records == ()
    assert alignment.n_used == alignment.n_records == N_RECORDS


def test_only_bad_records_are_accused(spoiled, chosen, clean):
    _, alignment, found = spoiled
    assert set(found) <= set(np.concatenate(chosen).tolist())
    assert alignment.n_used == N_RECORDS - len(found)
    centres = np.array([facet.theta_rad for facet in alignment.facets])
    assert np.sqrt(np.mean((centres - clean.centre_rad) ** 2)) < 0.3 * ARCMIN


def test_wrong_stars_are_named_with_both_places(spoiled, chosen, clean):
    """The facets that light up tell where the star really stood."""
    run, _, found = spoiled
    assert sum(found[row].kind == "wrong_star" for row in chosen[0] if row in found) >= 4
    for row in chosen[0]:
        if row in found:
            seen = run.table.theta_rad[row] / DEG
            assert f"({seen[0]:+.3f}, {seen[1]:+.3f})" in found[row].detail
            told = np.array(found[row].detail.split("belong to (")[1].split(")")[0].split(","), dtype=float)
            # directions are tried on a grid of one width, 1.5 arcmin
            np.testing.assert_allclose(told, clean.table.theta_rad[row] / DEG, atol=2 * 1.5 / 60)
            assert found[row].facet_ids


def test_stray_light_is_found(spoiled, chosen):
    _, _, found = spoiled
    assert [found[row].kind for row in chosen[1]] == ["stray_light"] * 5


@pytest.mark.parametrize(("which", "factor"), [(2, DIMMED), (3, BRIGHTENED)])
def test_a_clouds_edge_is_found(spoiled, chosen, which, factor):
    """The star camera saw another transparency than the reflector camera."""
    _, _, found = spoiled
    records = [found[row] for row in chosen[which] if row in found and found[row].kind == "cloud_edge"]
    assert len(records) >= 2
    told = float(records[0].detail.split("all facets ")[1].split(" times")[0])
    assert 0.4 < told / factor < 2.5  # factors are tried in steps of 1.5


def test_a_facet_whose_brightest_record_is_bad_is_named(clean, chosen):
    row = int(chosen[1][0])
    response = clean.table.response.copy()
    response[row] = 3.0 * response.max(axis=0)
    alignment = reconstruct(clean.with_response(response).table, DISH, "brightest").alignment
    assert [record.index for record in alignment.bad_records] == [row + 1]  # records are numbered from 1
    assert all("RESTS_ON_BAD_RECORD" in facet.flags.names for facet in alignment.facets)
    named = [line for line in alignment.remarks if "single brightest record" in line]
    assert len(named) == 12
    assert f"number {row + 1} " in named[0]


def test_two_facets_accuse_nobody():
    """Two witnesses can not outvote a star position."""
    run = make_run(11, 300, n_facets=2)
    theta = run.table.theta_rad.copy()
    theta[np.argsort(-run.light.sum(axis=1))[:3]] += 0.2 * DEG
    assert reconstruct(run.with_theta(theta).table, DISH).alignment.bad_records == ()
