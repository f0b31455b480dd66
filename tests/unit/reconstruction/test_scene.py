"""A scene that changes while the star fades, on made runs of known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from response_maker import ARCMIN, MadeRun, instrument, make_run, wandering_path

from namod_ctl.core.records import Record
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import ResponseTable, tabulate_responses
from namod_ctl.reconstruction.scene import without_scene


def _under_cloud(run: MadeRun, seed: int, scene: float) -> ResponseTable:
    """The run as it would be recorded under clouds of factor 30, the facets' scene growing threefold meanwhile."""
    rng = np.random.default_rng(seed)
    n, n_facets = run.table.response.shape
    progress = np.linspace(0.0, 1.0, n)
    star = np.exp(-np.log(30.0) * np.sin(17.0 * progress + rng.uniform(0.0, 6.0)) ** 2)
    of_facet = scene * rng.uniform(0.5, 2.0, n_facets) * (1.0 + 2.0 * progress[:, None])
    of_facet *= 1.0 + 0.03 * rng.standard_normal((n, n_facets))
    intensity = run.table.response * star[:, None] + of_facet
    nothing = np.zeros(n_facets)
    records = [
        Record(i, "", run.table.theta_rad[i], np.nan, star[i], intensity[i], nothing, np.nan, np.nan) for i in range(n)
    ]
    return tabulate_responses(records, run.table.facet_ids)


@pytest.mark.parametrize("seed", [3])
def test_a_growing_scene_under_clouds_loses_no_facet(seed: int) -> None:
    """At the darkest, the scene is as bright as a lit facet; the limit is a quarter of a facet's width."""
    run = make_run(seed, n_records=600, path=wandering_path)
    facets = reconstruct(_under_cloud(run, seed, 0.003), instrument()).alignment.facets
    found = np.array([facet.theta_rad for facet in facets])
    assert np.sqrt(np.mean((found - run.centre_rad) ** 2)) < 0.4 * ARCMIN


def test_a_steady_star_leaves_the_responses_as_they_are() -> None:
    run = make_run(1, n_records=100)
    assert without_scene(run.table, [None] * 30) is run.table


def test_the_scene_is_what_unlit_records_show() -> None:
    """Facets that never light up show the scene only: nothing is left of it but its noise of 3 %."""
    run = make_run(2, n_records=400)
    dark = replace(run, table=replace(run.table, response=np.full(run.table.response.shape, 1e-6)))
    shown = _under_cloud(dark, 2, 0.1)
    left = without_scene(shown, [None] * 30)
    before, after = (np.median(np.abs(table.response / table.faintness[:, None])) for table in (shown, left))
    assert after < 0.1 * before
