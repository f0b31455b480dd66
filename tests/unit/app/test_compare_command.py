"""Two runs of one telescope beside each other: facets that moved are found, by how much, and no others."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
from output_samples import alignment_of, facet_alignment, unknown_facet
from small_night import FACET_IDS, record, small_config, small_twin
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.app.views.drift_table import drift_csv, drift_summary
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import arcmin_to_rad, rad_to_arcmin
from namod_ctl.reconstruction.drift import FALSE_ALARM, drift_between
from namod_ctl.store.run import RunStore

SHIFT_RAD = arcmin_to_rad(np.array([0.8, -0.5]))
TURNED = 21
TILT_RAD = arcmin_to_rad(np.array([0.35, -0.25]))  # of the normal; the star is then seen twice as far off


def pair(rng, n_facets=30, shift_rad=SHIFT_RAD, moved_rad=None):
    """Two measured alignments of one true mirror; `moved_rad` is what facets moved by, by id."""
    first, second = [], []
    for facet_id in range(1, n_facets + 1):
        true = rng.normal(0.0, arcmin_to_rad(4.0), 2)
        for facets, offset in ((first, 0.0), (second, shift_rad + (moved_rad or {}).get(facet_id, 0.0))):
            root = arcmin_to_rad(1.0) * rng.uniform(-0.3, 0.3, (2, 2)) + arcmin_to_rad(0.1) * np.eye(2)
            cov = root @ root.T
            measured = rng.multivariate_normal(true + offset, cov)
            facets.append(replace(facet_alignment(facet_id), theta_rad=measured, theta_cov_rad2=cov))
    return alignment_of(first), alignment_of(second)


def test_the_one_facet_that_moved_is_found_and_the_common_shift_is_not_its():
    moved = arcmin_to_rad(np.array([3.0, 2.0]))
    drift = drift_between(*pair(np.random.default_rng(1), moved_rad={7: moved}))
    assert drift.moved_ids == (7,)
    off = drift.shift_rad - SHIFT_RAD
    assert off @ np.linalg.solve(drift.shift_cov_rad2, off) < 14.0  # chi^2 of two numbers: 1 in 1000
    found = drift.facets[6]
    left = found.drift_rad - moved
    assert left @ np.linalg.solve(found.drift_cov_rad2, left) < 14.0
    assert found.significance_sigma > 5.0


def test_a_mirror_that_stood_still_is_seldom_said_to_have_moved():
    rng = np.random.default_rng(2)
    n_runs = 300
    alarms = sum(bool(drift_between(*pair(rng)).moved_ids) for _ in range(n_runs))
    # the robust shift is a little less certain than it says: 3 times the promised share is allowed
    assert alarms <= 3 * FALSE_ALARM * n_runs


@pytest.mark.parametrize("n_facets", [4, 30])
def test_drifts_scatter_as_their_covariances_say(n_facets):
    """With few facets the common shift is partly each facet's own: what they share must be counted once."""
    rng = np.random.default_rng(3)
    chi2 = []
    for _ in range(150):
        drift = drift_between(*pair(rng, n_facets))
        chi2 += [f.drift_rad @ np.linalg.solve(f.drift_cov_rad2, f.drift_rad) for f in drift.facets]
    assert np.median(chi2) == pytest.approx(2.0 * np.log(2.0), rel=0.15)  # of chi^2 of two numbers


def test_a_mirror_that_was_aligned_anew_has_no_common_shift_to_speak_of():
    rng = np.random.default_rng(4)
    moved = {i: rng.normal(0.0, arcmin_to_rad(4.0), 2) for i in range(1, 31)}
    drift = drift_between(*pair(rng, shift_rad=np.zeros(2), moved_rad=moved))
    assert len(drift.moved_ids) > 15
    assert drift.scatter > 5.0
    assert np.all(np.abs(drift.shift_rad) < 4.0 * np.sqrt(np.diag(drift.shift_cov_rad2)))


def test_facets_that_cannot_be_compared_are_named_and_never_guessed():
    first, second = pair(np.random.default_rng(5))
    facets = list(second.facets)
    facets[2] = unknown_facet(3)
    facets[4] = replace(facets[4], theta_rad=facets[4].theta_rad + 0.01, flags=FacetFlag.UNRELIABLE)
    drift = drift_between(first, replace(second, facets=(*facets[:-1], facet_alignment(99))))
    assert (drift.only_in_first, drift.only_in_second) == ((30,), (99,))
    rows = {int(row["facet_id"]): row for row in csv.DictReader(drift_csv(drift).splitlines())}
    assert rows[3]["drift_x_arcmin"] == rows[3]["significance_sigma"] == ""
    assert rows[3]["flags_2"] == "NO_SIGNAL"
    assert drift.moved_ids == ()  # nobody says that facet 5 moved when its estimate is unreliable
    assert float(rows[5]["significance_sigma"]) > 5.0
    assert "only in there: facet 99" in drift_summary(drift, (first, second), ("here", "there"))


def test_two_facets_are_too_few():
    with pytest.raises(DataQualityError, match="at least 3"):
        drift_between(*pair(np.random.default_rng(6), n_facets=2))


@pytest.fixture(scope="module")
def nights(tmp_path_factory):
    """Three nights on one twin; before the second a facet was turned, the third has another star camera."""
    folder = tmp_path_factory.mktemp("nights")
    config = small_config()
    twin = small_twin(config)
    record(folder / "before", twin, config, 110)
    tilts = np.zeros((len(FACET_IDS), 2))
    tilts[twin.reflector.ids.index(TURNED)] = TILT_RAD
    twin.reflector.apply_correction(tilts)
    record(folder / "after", twin, config, 110)
    other = small_config(columns=600, rows=460, axis_px=(300.0, 230.0), plate_scale_mdeg_per_px=2.6)
    twin = small_twin(other)
    record(folder / "other_camera", twin, other, 110)
    return folder


def call(*arguments):
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_the_facet_that_was_turned_on_the_twin_is_found(nights, tmp_path):
    result = call(nights / "before", nights / "after", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert f"moved: {TURNED} (1 of {len(FACET_IDS)}" in result.output
    rows = {row["facet_id"]: row for row in csv.DictReader((tmp_path / "compare.csv").read_text().splitlines())}
    row = rows[str(TURNED)]
    expected = rad_to_arcmin(2.0 * TILT_RAD)
    for axis, want in zip("xy", expected, strict=True):
        doubt = float(row[f"drift_{axis}_uncertainty_arcmin"])
        assert float(row[f"drift_{axis}_arcmin"]) == pytest.approx(want, abs=4.0 * doubt)
        assert doubt < 0.4
    assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_another_star_camera_does_not_matter(nights, tmp_path):
    result = call(nights / "before", nights / "other_camera", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "moved: none" in result.output


def test_refusals_say_what_to_do(nights, tmp_path):
    def refusal(*arguments):
        result = call(*arguments)
        assert isinstance(result.exception, ConfigError), result.output
        return str(result.exception)

    before, after = nights / "before", nights / "after"
    assert "named twice" in refusal(before, before)
    assert "does not exist" in refusal(before, after, "--out", tmp_path / "no")
    assert "there are" in refusal(before, nights / "nope")
    assert str(after) in refusal(before, nights / "nope")
    fresh = shutil.copytree(after, tmp_path / "fresh")
    (fresh / "alignment.json").unlink()
    assert f"namod-ctl reconstruct {fresh}" in refusal(before, fresh)
    assert not list(tmp_path.glob("*.csv"))


@pytest.mark.parametrize("what", ["name", "place"])
def test_runs_of_other_telescopes_are_refused(nights, tmp_path, what):
    config = small_config()
    if what == "name":
        config = config.model_copy(update={"telescope": config.telescope.model_copy(update={"name": "FACT 2"})})
    else:
        moved = config.facets[0].model_copy(update={"position_m": (0.0, 0.0, 0.0)})
        reflector = config.reflector.model_copy(update={"facets": (moved, *config.facets[1:])})
        config = config.model_copy(update={"reflector": reflector})
    other = shutil.copytree(nights / "after", tmp_path / "other")
    with RunStore.open(nights / "after") as run:
        facet_ids, clock = run.facet_ids, small_twin(small_config()).wall_clock
    shutil.rmtree(other)
    RunStore.create(other, facet_ids, config.to_json(), "made", clock).close()
    text = (nights / "after" / "alignment.json").read_text()
    (other / "alignment.json").write_text(
        text.replace('"telescope": "FACT"', f'"telescope": "{config.telescope.name}"')
    )
    result = call(nights / "before", other, "--out", tmp_path)
    assert isinstance(result.exception, ConfigError)
    assert "only runs of one telescope" in str(result.exception)
