"""The telescope's wandering: within its region, over all of it, at its speed, and a function of time alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from namod_ctl.core.units import arcmin_to_rad, rad_to_arcmin
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.settings import FaultSpec, TelescopeSettings
from namod_ctl.twin.telescope import Telescope

PATTERNS = ("spiral", "raster", "random")
SMOOTH = TelescopeSettings(jitter_rad=0.0)


def telescope(pattern: str, plan: FaultPlan | None = None, seed: int = 1) -> Telescope:
    return Telescope(replace(SMOOTH, pattern=pattern), plan or FaultPlan(), seed)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_it_covers_its_region_and_stays_there(pattern: str) -> None:
    path = telescope(pattern)
    n_passes = 2.0 if pattern != "spiral" else 1.0  # the raster's square is larger; chance leaves gaps
    theta = path.star_theta(np.linspace(0.0, n_passes * path.pass_s, 20_000)) / SMOOTH.radius_rad
    # A smooth way through points of the disc swings a little beyond; a raster fills the square.
    assert np.abs(theta).max() <= (1.15 if pattern != "raster" else np.sqrt(2.0) + 1e-9)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 15)), axis=-1).reshape(-1, 2)
    inside = grid[np.linalg.norm(grid, axis=1) < 0.9]
    gap = np.array([np.linalg.norm(theta - point, axis=1).min() for point in inside])
    assert gap.max() < (0.06 if pattern != "random" else 0.25)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_its_mean_speed_is_as_asked(pattern: str) -> None:
    times_s = np.linspace(0.0, 400.0, 40_001)
    way = np.linalg.norm(np.diff(telescope(pattern).star_theta(times_s), axis=0), axis=1).sum()
    assert rad_to_arcmin(float(way)) / 400.0 == pytest.approx(1.0, rel=0.25)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_it_moves_without_leaps_even_between_passes(pattern: str) -> None:
    path = telescope(pattern)
    times_s = np.arange(0.0, 2.2 * path.pass_s, 0.1)
    step = np.linalg.norm(np.diff(path.star_theta(times_s), axis=0), axis=1)
    # The spiral runs through its centre; that is its one fast moment.
    assert rad_to_arcmin(float(step.max())) < 1.5


def test_it_depends_on_the_moment_and_the_seed_only() -> None:
    times_s = np.array([5.0, 100.0, 7.0])
    once, again = telescope("random").star_theta(times_s), telescope("random").star_theta(times_s[::-1])[::-1]
    np.testing.assert_array_equal(once, again)
    assert not np.allclose(once, telescope("random", seed=2).star_theta(times_s))


def test_jitter_has_its_size() -> None:
    jittering = replace(SMOOTH, jitter_rad=arcmin_to_rad(0.1))
    times_s = np.linspace(0.0, 600.0, 30_000)
    away = Telescope(jittering, FaultPlan(), 1).star_theta(times_s) - telescope("spiral").star_theta(times_s)
    np.testing.assert_allclose(rad_to_arcmin(away.std(axis=0)), 0.1, rtol=0.1)


def test_it_jumps_and_comes_back() -> None:
    plan = FaultPlan()
    plan.inject(FaultSpec("telescope_jump", 10.0, 5.0, {"x_rad": 2e-3, "y_rad": 0.0}))
    away = telescope("spiral", plan).star_theta(np.array([9.9, 10.0, 14.9, 15.1])) - telescope("spiral").star_theta(
        np.array([9.9, 10.0, 14.9, 15.1])
    )
    np.testing.assert_allclose(away[:, 0], [0.0, 2e-3, 2e-3, 0.0], atol=1e-12)
