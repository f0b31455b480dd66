"""alignment.json and its tables: the schema of the design, and nothing lost on the way."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st
from output_samples import alignment_of, facet_alignment, random_alignment, unknown_facet

from namod_ctl.app.alignment_files import (
    alignment_from_json,
    alignment_to_json,
    facet_table,
    read_alignment,
    table_to_fits,
    write_alignment,
)
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.reconstruction.alignment import AreaOfPsf


def sample():
    cut = facet_alignment(13, (0.071, 0.052), flags=FacetFlag.PSF_CUT_BY_SCAN_EDGE, remarks=("cut on the left",))
    return alignment_of([cut, unknown_facet(14)])


def test_the_file_is_as_the_design_says():
    file = json.loads(alignment_to_json(sample()))
    assert file["schema"] == "namod-alignment/1"
    assert (file["telescope"], file["n_records"], file["n_used"], file["estimator"]) == ("FACT", 300, 288, "robust")
    assert file["axis_deg"] == pytest.approx([0.01, -0.02])
    # 1 arcmin is 2.908882e-4 rad
    assert file["a_sigma_arcmin2"]["now"] == pytest.approx(5.3e-6 / 2.908882e-4**2, rel=1e-6)
    assert file["a_sigma_arcmin2"]["predicted_after_correction"] == pytest.approx(6e-7 / 2.908882e-4**2, rel=1e-6)
    facet = file["facets"][0]
    assert facet["id"] == 13
    assert facet["theta_x_deg"] == pytest.approx(0.071)
    assert facet["tilt_correction_x_rad"] == pytest.approx(-0.00062, abs=5e-6)  # the design's own example
    assert facet["tilt_correction_y_rad"] == pytest.approx(-0.00045, abs=5e-6)
    assert facet["theta_cov_deg2"][0] == pytest.approx([1.6e-5, 4.8e-6])
    assert facet["flags"] == ["PSF_CUT_BY_SCAN_EDGE"]
    assert facet["n_records_in_psf"] == 40
    assert len(facet["leg_travel_m"]) == len(facet["bolt_turn_deg"]) == 3


def test_a_facet_without_estimate_has_nulls_and_its_flag():
    facet = json.loads(alignment_to_json(sample()))["facets"][1]
    assert facet["theta_x_deg"] is None
    assert facet["theta_cov_deg2"] == [[None, None], [None, None]]
    assert facet["bolt_turn_deg"] == [None, None, None]
    assert facet["flags"] == ["NO_SIGNAL"]


numbers = st.floats(-1e3, 1e3) | st.just(float("nan"))


@given(
    st.tuples(numbers, numbers),
    st.integers(0, 127).map(FacetFlag),
    st.lists(st.text(max_size=30), max_size=3),
    st.floats(0, 1e-3) | st.just(float("nan")),
)
def test_round_trip(theta_deg, flags, remarks, area):
    facet = facet_alignment(5, theta_deg, flags=flags, remarks=tuple(remarks))
    alignment = alignment_of([facet], now=AreaOfPsf(area, area / 10))
    again = alignment_from_json(alignment_to_json(alignment), "there")
    (back,) = again.facets
    for name in ("theta_rad", "theta_cov_rad2", "tilt_correction_rad", "leg_travel_m", "bolt_turn_deg"):
        np.testing.assert_allclose(getattr(back, name), getattr(facet, name), rtol=1e-12, equal_nan=True)
    for name in ("width_major_rad", "width_minor_rad", "flux", "background"):
        assert getattr(back, name) == pytest.approx(getattr(facet, name), rel=1e-12)
    assert (back.flags, back.remarks, back.n_records_in_psf) == (flags, tuple(remarks), 40)
    assert again.now.a_sigma_rad2 == pytest.approx(area, rel=1e-12, nan_ok=True)
    assert (again.bad_records, again.facets_not_in_run, again.remarks) == (
        alignment.bad_records,
        alignment.facets_not_in_run,
        alignment.remarks,
    )


def damaged(change):
    file = json.loads(alignment_to_json(sample()))
    change(file)
    return json.dumps(file)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "JSON"),
        ("[]", "whole file"),
        (damaged(lambda file: file.update(schema="namod-alignment/2")), "key schema"),
        (damaged(lambda file: file.update(n_records="300")), "key n_records"),
        (damaged(lambda file: file.update(extra=1)), "key extra"),
        (damaged(lambda file: file["facets"][1].pop("theta_y_deg")), r"key facets\.1\.theta_y_deg"),
        (damaged(lambda file: file["facets"][0].update(flags=["SHINY"])), "facet 13: flags: 'SHINY'"),
        (damaged(lambda file: file["facets"][0].update(theta_cov_deg2=[[1, 0]])), r"key facets\.0\.theta_cov_deg2"),
    ],
)
def test_another_file_is_refused_by_key(text, named):
    with pytest.raises(ConfigError, match=f"there: .*{named}") as caught:
        alignment_from_json(text, "there")
    assert "namod-ctl reconstruct" in str(caught.value)


@pytest.mark.parametrize("key", sorted(json.loads(alignment_to_json(sample()))))
def test_no_key_may_be_missing(key):
    with pytest.raises(ConfigError, match=f"key {key}"):
        alignment_from_json(damaged(lambda file: file.pop(key)), "there")


def test_files_of_a_run(tmp_path):
    alignment = sample()
    write_alignment(tmp_path, alignment)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alignment.json", "facets.ecsv"]
    assert [facet.facet_id for facet in read_alignment(tmp_path).facets] == [13, 14]
    table = QTable.read(tmp_path / "facets.ecsv", format="ascii.ecsv")
    assert table["theta_x"].unit == u.deg
    assert table["theta_x"][0].to_value(u.deg) == pytest.approx(0.071)
    assert np.isnan(table["theta_x"][1])
    assert table["leg_1_travel"][0].to_value(u.m) == pytest.approx(alignment.facets[0].leg_travel_m[0])
    assert table["theta_x_uncertainty"][0].to_value(u.rad) == pytest.approx(deg_to_rad(0.004))
    assert list(table["flags"]) == ["PSF_CUT_BY_SCAN_EDGE", "NO_SIGNAL"]
    assert table["theta_y"].info.description


def test_fits_table_has_the_same_numbers(tmp_path):
    alignment = sample()
    table = QTable.read(io.BytesIO(table_to_fits(facet_table(alignment))), format="fits")
    assert table["bolt_1_turn"].unit == u.deg
    assert table["bolt_1_turn"][0].value == pytest.approx(alignment.facets[0].bolt_turn_deg[0])
    assert table.meta["TELESCOP"] == "FACT"


def test_legs_may_differ_in_number():
    table = facet_table(alignment_of([facet_alignment(1), unknown_facet(2, n_bolts=2)]))
    assert len(table.colnames) == len(facet_table(alignment_of([facet_alignment(1)])).colnames)
    assert np.isnan(table["bolt_3_turn"][1])


def test_no_alignment_yet(tmp_path):
    with pytest.raises(ConfigError, match="namod-ctl reconstruct"):
        read_alignment(tmp_path)


def test_an_empty_alignment_can_be_written(tmp_path):
    write_alignment(tmp_path, alignment_of([]))
    assert read_alignment(tmp_path).facets == ()


def test_a_thousand_facets(tmp_path):
    class Thousand:
        ids = range(1000)

    write_alignment(tmp_path, random_alignment(Thousand))
    assert len(read_alignment(tmp_path).facets) == 1000
