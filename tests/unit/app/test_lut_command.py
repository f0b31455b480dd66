"""Look-up tables over zenith distance from runs to files, tables, sheets and legs: by the commands themselves."""

from __future__ import annotations

import csv
import json
import math
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lut_samples import (
    config,
    run_at,
    sky_at,
    true_lut,
    twin_reflector,
    write_lut,
)
from typer.testing import CliRunner

from namod_ctl.app.build.gravity_runs import read_gravity_runs
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.run_zenith import when_facets_were_seen, zenith_of_run
from namod_ctl.app.commands.lut import app
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.config.schema import SiteSection
from namod_ctl.app.lut.files import lut_from_json, lut_to_json, read_lut
from namod_ctl.core.errors import ConfigError, NamodError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.store.run import RunStore
from namod_ctl.twin.reflector import TwinReflector

ZENITHS = (10.5, 25.0, 40.0, 60.0)


@pytest.fixture(scope="module")
def reflector() -> TwinReflector:
    return twin_reflector()


@pytest.fixture(scope="module")
def runs(reflector: TwinReflector, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    return [run_at(folder, zenith_deg, reflector) for zenith_deg in ZENITHS]


@pytest.fixture
def lut(reflector: TwinReflector, tmp_path: Path) -> Path:
    return write_lut(tmp_path / "LUT.json", true_lut(reflector))


def refusal(*words: object) -> str:
    """What a command that must be refused says."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, NamodError), result.output
    return str(result.exception)


def said(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_runs_of_the_twin_know_where_it_stood(runs: list[Path]) -> None:
    with RunStore.open(runs[2]) as store:
        seen = when_facets_were_seen(store)
        assert seen is not None
        path = zenith_of_run(store, seen.times_s)
    assert path is not None
    zenith_deg = rad_to_deg(path.zenith_rad)
    assert zenith_deg[0] == pytest.approx(40.0, abs=1e-6)
    assert path.side() == 1.0
    # in 110 s the sky turns by 0.46 deg, by cos(declination) of that on a great circle, and Vega sets obliquely
    assert 0.2 < zenith_deg[-1] - zenith_deg[0] < 0.46 * math.cos(deg_to_rad(38.78)) + 0.01
    np.testing.assert_allclose(seen.share.sum(axis=1), 1.0)


def test_vega_culminates_where_its_declination_says() -> None:
    assert sky_at(5.0) == sky_at(10.0)  # never nearer to La Palma's zenith than 38.78 - 28.76 = 10.02 deg


def test_fit_finds_the_twins_sag_and_its_table_tells_it(
    runs: list[Path], reflector: TwinReflector, tmp_path: Path
) -> None:
    out = tmp_path / "LUT.json"
    text = said("fit", *runs, "--out", out)
    found, truth = read_lut(out), true_lut(reflector).table
    assert found.table.terms == ("sin",)
    assert found.is_good
    # rounding of light weights aside
    error = found.table.beta_rad[:, 1] - truth.beta_rad[:, 1]
    error -= found.table.light @ error
    sigma = np.sqrt(np.diagonal(found.table.cov_rad2[:, 1, :, 1, :], axis1=1, axis2=2))
    assert 0.75 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.25
    assert "hysteresis was not measured" in text
    assert "whole image moved" in text
    with pytest.raises(ConfigError, match="the file exists"):
        CliRunner().invoke(app, ["fit", *map(str, runs), "--out", str(out)], catch_exceptions=False)
    shown = said("show", out, "--zenith-deg", 40)
    assert (tmp_path / "lut.png").read_bytes().startswith(b"\x89PNG")
    assert "times the limit" in shown
    assert "sin z: x, y" in shown


def test_zenith_distances_by_hand(reflector: TwinReflector, tmp_path: Path) -> None:
    taken = [run_at(tmp_path, zenith_deg, reflector, knows_zenith=False) for zenith_deg in ZENITHS]
    out = tmp_path / "LUT.json"
    assert "--zenith-deg 10,25,40,60" in refusal("fit", *taken, "--out", out)
    assert "3 numbers for 4 runs" in refusal("fit", *taken, "--out", out, "--zenith-deg", "10,25,40")
    assert "90 minus" in refusal("fit", *taken, "--out", out, "--zenith-deg", "10,25,40,120")
    assert "commas" in refusal("fit", *taken, "--out", out, "--zenith-deg", "10;25")
    assert "no side" in refusal("fit", *taken, "--out", out, "--zenith-deg", "10,25,40,60", "--from", "a,b,c,d")
    # the order of zenith distances exchanged: facets do not follow any sag then
    assert "one state of the mirror" in refusal("fit", *taken, "--out", out, "--zenith-deg", "25,60,10,40")
    assert not out.exists()
    said("fit", *taken, "--out", out, "--zenith-deg", "10.5,25,40,60")
    assert {run.came_from for run in read_lut(out).runs} == {"unknown"}


class _Then:
    """A clock that stands still."""

    def __init__(self, moment: datetime) -> None:
        self._moment = moment

    def now(self) -> datetime:
        return self._moment


def test_zenith_distances_by_star_and_site(reflector: TwinReflector, tmp_path: Path) -> None:
    """Against the sidereal time of the US Naval Observatory's formula and Vega's place of J2000: 26 years of precession
    and refraction are 0.2 deg."""
    site = SiteSection(latitude_deg=28.76, longitude_deg=-17.89, altitude_m=2200.0)
    used = config().model_copy(update={"site": site})
    taken, expected = [], []
    for hour, zenith_deg in ((21, 10.5), (23, 35.0), (25, 60.0)):
        moment = datetime(2026, 8, 10, tzinfo=UTC) + timedelta(hours=hour)
        taken.append(run_at(tmp_path, zenith_deg, reflector, knows_zenith=False, used=used, clock=_Then(moment)))
        days = (moment - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400.0
        sidereal_h = 18.697374558 + 24.06570982441908 * days + site.longitude_deg / 15.0
        hour_angle, declination, latitude = map(math.radians, (15.0 * (sidereal_h - 18.6156), 38.7837, 28.76))
        cosine = math.sin(latitude) * math.sin(declination)
        cosine += math.cos(latitude) * math.cos(declination) * math.cos(hour_angle)
        expected.append(math.degrees(math.acos(cosine)))
    out = tmp_path / "LUT.json"
    read = read_gravity_runs(taken, None, ["Vega"] * 3, None)
    assert [rad_to_deg(run.path.mean_rad) for run in read.runs] == pytest.approx(expected, abs=0.35)
    assert "no star" in refusal("fit", *taken, "--out", out, "--star", "Wega")
    assert "leave one out" in refusal("fit", *taken, "--out", out, "--star", "Vega", "--zenith-deg", "10,20,30")
    assert "2 names for 3 runs" in refusal("fit", *taken, "--out", out, "--star", "Vega,Deneb")
    here = run_at(tmp_path, 20.0, reflector, knows_zenith=False)
    assert "no [site]" in refusal("fit", here, *taken, "--out", out, "--star", "Vega")
    assert not out.exists()


def test_wrong_runs_are_refused(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "LUT.json"
    assert "named twice" in refusal("fit", runs[0], runs[1], runs[0], "--out", out)
    assert "no run" in refusal("fit", runs[0], runs[1], tmp_path, "--out", out)
    copy = tmp_path / "copy"
    shutil.copytree(runs[0], copy)
    assert "copy of that run" in refusal("fit", runs[0], runs[1], copy, "--out", out)
    assert "at least 3 are needed" in refusal("fit", runs[0], runs[1], "--out", out)
    assert "is a folder" in refusal("fit", *runs, "--out", tmp_path)
    assert "does not exist" in refusal("fit", *runs, "--out", tmp_path / "nowhere" / "LUT.json")
    assert not out.exists()


def test_the_file_holds_all_of_the_table(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "LUT.json"
    said("fit", *runs, "--out", out)
    text = out.read_text()
    assert json.loads(text)["schema"] == "namod-lut/1"
    again = lut_from_json(lut_to_json(lut_from_json(text, "here")), "again")
    first = lut_from_json(text, "here")
    np.testing.assert_allclose(again.table.beta_rad, first.table.beta_rad, rtol=1e-12)
    np.testing.assert_allclose(again.table.cov_rad2, first.table.cov_rad2, rtol=1e-12)
    assert again.runs == first.runs
    assert again.tests == first.tests


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_a_message(reflector: TwinReflector, data: st.DataObject) -> None:
    """Any value anywhere replaced, or any key gone: either it still is a table, or it is a ConfigError."""
    raw = json.loads(lut_to_json(true_lut(reflector)))
    where = raw
    while True:
        key = data.draw(st.sampled_from(sorted(where) if isinstance(where, dict) else range(len(where))))
        if isinstance(where[key], (dict, list)) and where[key] and data.draw(st.booleans()):
            where = where[key]
            continue
        break
    junk = st.sampled_from([None, "x", -1, 1e300, [], {}, [1, 2, 3], True])
    if isinstance(where, dict) and data.draw(st.booleans()):
        del where[key]
    else:
        where[key] = data.draw(junk)
    words = ""
    try:
        lut_from_json(json.dumps(raw), "LUT.json")
    except ConfigError as problem:
        words = str(problem)
    assert not words or words.startswith("LUT.json: key ")


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"schema": "namod-lut/2"}'])
def test_what_is_no_table_is_a_message(text: str) -> None:
    with pytest.raises(ConfigError, match=r"LUT\.json"):
        lut_from_json(text, "LUT.json")


def test_bias_alignment_gives_sheets_and_aims(lut: Path, tmp_path: Path, reflector: TwinReflector) -> None:
    text = said("bias", lut, "--from-deg", 5, "--to-deg", 65, "--out", tmp_path, "--aligned-at-deg", 10)
    for name in ("instructions.csv", "instructions.png", "instructions.pdf", "bias_aims.csv", "bias.png"):
        assert (tmp_path / name).stat().st_size > 100
    turns = {
        int(row["facet_id"]): row for row in csv.DictReader((tmp_path / "instructions.csv").read_text().splitlines())
    }
    aims = {int(row["facet_id"]): row for row in csv.DictReader((tmp_path / "bias_aims.csv").read_text().splitlines())}
    assert set(turns) == set(aims) == set(reflector.ids)
    # turned as the sheet says, with whole degrees, the twin aligned at 10 deg is at the promised area at 65 deg
    mounts = build_instrument(load_config("fact")).mounts
    stood = reflector.base_tilt_rad
    try:
        for _ in range(2):
            reflector.apply_correction(reflector.correction_at_rad(deg_to_rad(10.0)))
        limit = reflector.a_sigma_aligned_rad2()
        before = reflector.a_sigma_at_rad2(deg_to_rad(65.0)) / limit
        correction = np.zeros((len(reflector.ids), 2))
        for j, facet_id in enumerate(reflector.ids):
            degrees = [float(turns[facet_id][f"bolt_{k}_deg"]) for k in (1, 2, 3)]
            mount = mounts[facet_id]
            raised = 1.0 if mount.turn_raises_leg == "clockwise" else -1.0
            correction[j] = mount.tilt_of_travel(raised * np.array(degrees) / 360.0 * mount.pitch_m_per_turn)
        reflector.apply_correction(correction)
        after = reflector.a_sigma_at_rad2(deg_to_rad(65.0)) / limit
        there = np.array([[float(aims[i][f"theta_{a}_arcmin_at_65.0_deg"]) for a in "xy"] for i in reflector.ids])
    finally:
        reflector.apply_correction(stood - reflector.base_tilt_rad)
    assert before > 1.2
    assert after < 1.0 + 0.6 * (before - 1.0)
    assert "aligned at 10 deg: mean" in text
    assert np.abs(there).max() > 0.3


def test_a_table_of_a_stiff_dish_can_be_shown_and_asks_for_nothing(reflector: TwinReflector, tmp_path: Path) -> None:
    full = true_lut(reflector)
    table = replace(
        full.table, terms=(), beta_rad=full.table.beta_rad[:, :1], cov_rad2=full.table.cov_rad2[:, :1, :, :1],
        is_moving=np.zeros(len(full.table.facet_ids), dtype=np.bool_),
    )  # fmt: skip
    odd = ("it does not follow a sag", *full.facet_remarks[1:])
    lut = write_lut(tmp_path / "LUT.json", replace(full, table=table, facet_remarks=odd))
    text = said("show", lut)
    assert f"Facet {table.facet_ids[0]} is left out: it does not follow a sag." in text
    assert "0 of 30 facets move" in text
    assert "1.000 ± 0.000" in text
    assert "nothing to compromise" in refusal("bias", lut)


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (("--from-deg", "40", "--to-deg", "20"), "must be the smaller"),
        (("--to-deg", "89"), "rests on runs"),
        (("--weights", "5:1,5:2"), "must ascend"),
        (("--weights", "5"), "weight with commas"),
        (("--weights", "5:0,65:0"), "are 0"),
        (("--config", "mst_like"), "is a table of FACT"),
        (("--out", "nowhere"), "does not exist"),
    ],
)
def test_wrong_wishes_for_a_compromise(lut: Path, words: tuple[str, ...], answer: str) -> None:
    assert answer in refusal("bias", lut, *words)
