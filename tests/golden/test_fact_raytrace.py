"""The ray-traced limit of FACT: 5.7 arcmin2.

Source: arXiv:1605.06274, section 5 (ray tracing of the perfect FACT); facets as measured, 30 rows of
`fact_facets_measured.txt` (cm), each spherical with R = 2 * 4.889 m, 0.606 m flat to flat, aimed at the focal point.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.core.units import cm_to_m, rad2_to_arcmin2
from namod_ctl.optics.raytrace import (
    a_sigma_rad2,
    combine_moments,
    facet_moments,
    trace,
    with_common_focal_length,
)
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

ROOT = Path(__file__).parents[2]
FACETS = ROOT / ".." / "shared" / "data" / "fact_2014" / "fact_facets_measured.txt"
F_M = 4.889

needs_facet_table = pytest.mark.skipif(not FACETS.exists(), reason="FACT's facet table is not here")


@pytest.fixture
def fact() -> Reflector:
    rows = cm_to_m(np.loadtxt(FACETS, usecols=(0, 1, 2, 6, 8)))
    facets = (Facet(j, row[:3], row[3], FacetShape.HEXAGON, row[4]) for j, row in enumerate(rows))
    return Reflector(F_M, tuple(facets))


def area_arcmin2(reflector: Reflector, n_rays: int) -> float:
    moments = combine_moments(facet_moments(trace(reflector, n_rays)))
    return rad2_to_arcmin2(a_sigma_rad2(moments.cov_m2, F_M))


@needs_facet_table
def test_perfect_fact(fact: Reflector) -> None:
    perfect = with_common_focal_length(fact)
    assert len(perfect.facets) == 30
    assert area_arcmin2(perfect, 2000) == pytest.approx(5.7, abs=0.1)


@needs_facet_table
def test_the_commands_default_number_of_rays_is_enough(fact: Reflector) -> None:
    for reflector in (fact, with_common_focal_length(fact)):
        assert area_arcmin2(reflector, 2000) == pytest.approx(area_arcmin2(reflector, 50_000), rel=0.005)


@needs_facet_table
def test_the_measured_normals_agree_with_the_aligned_ones(fact: Reflector) -> None:
    """The table's own normals were computed for FACT's focal point: 10 mrad off would be a wrong frame or sign."""
    measured = np.loadtxt(FACETS, usecols=(3, 4, 5))
    assert np.abs(fact.aligned_normals() - measured).max() < 0.01


def test_the_command_prints_the_limit() -> None:
    """The project's own config of FACT, so this runs without the shared data too."""
    config = str(ROOT / "config" / "fact.toml")
    printed = CliRunner().invoke(app, ["raytrace", "--config", config])
    assert printed.exit_code == 0
    row = next(line for line in printed.output.splitlines() if "A_sigma" in line)
    assert float(row.split("│")[2]) == pytest.approx(5.7, abs=0.1)
    as_json = json.loads(CliRunner().invoke(app, ["raytrace", "--config", config, "--json"]).output)
    assert as_json["telescope_focal_length"]["a_sigma_arcmin2"] == pytest.approx(5.7, abs=0.1)
    assert as_json["telescope_focal_length"]["relative_sampling_error"] < 0.005


def test_the_command_moves_the_image_against_the_star() -> None:
    config = str(ROOT / "config" / "fact.toml")
    options = ["raytrace", "--config", config, "--theta-x-deg", "1", "--json"]
    image = json.loads(CliRunner().invoke(app, options).output)["own_focal_lengths"]
    # -f tan(1 deg) = -85.3 mm, and 2 % of coma outwards.
    assert image["centroid_x_mm"] == pytest.approx(-85.3, rel=0.03)
    assert image["centroid_y_mm"] == pytest.approx(0.0, abs=0.1)
