"""Calibration files: what is written is read, what must not be used is refused, and what is used takes effect."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.calibration_files import check_calibration_output, new_header, write_calibration
from namod_ctl.app.cli import app
from namod_ctl.app.config.calibration_schema import (
    AxisCalibration,
    DarkCalibration,
    DistortionSection,
    GeometryCalibration,
    LawSection,
    RadiometricCalibration,
)
from namod_ctl.app.config.calibrations import calibration_to_json, read_calibration
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, load_config
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_mdeg

NOW = datetime(2026, 11, 22, 21, 0, tzinfo=UTC)


class Clock:
    def now(self):
        return NOW


def header(role="star_camera", **changes):
    camera = getattr(load_config("fact"), role)
    return new_header(camera, role, Clock(), source="12 frames of a lamp") | changes


def geometry(**changes):
    values = {
        "kind": "geometry",
        "plate_scale_mdeg_per_px": 2.4401,
        "plate_scale_uncertainty_mdeg_per_px": 0.0004,
        "rotation_deg": 12.5,
        "rotation_uncertainty_deg": 0.01,
        "mirrored": True,
        "distortion": DistortionSection(centre_px=(1270.0, 950.0), k1_per_rad2=-0.3333),
        "residual_rms_px": 0.05,
        "method": "star field",
        "n_points": 14,
    }
    return GeometryCalibration(**(header() | values | changes))


def radiometric(**changes):
    values = {
        "kind": "radiometric",
        "law": LawSection(name="curved", r_resp=1.25, r_expo=-1.2, r_const=0.9, r_curve=0.03),
        "covariance": ((1e-6, 0.0, 0.0, 0.0), (0.0, 1e-6, 0.0, 0.0), (0.0, 0.0, 1e-6, 0.0), (0.0, 0.0, 0.0, 1e-6)),
        "intensity_unit": "of the lamp at 1 m",
        "saturation_share": 0.95,
        "usable_response_share": (0.01, 0.95),
        "usable_exposure_s": (0.001, 3.0),
        "residual_rms_share": 0.004,
    }
    return RadiometricCalibration(**(header() | values | changes))


def dark(**changes):
    values = {
        "kind": "dark",
        "bias_adu": 5.0,
        "rate_adu_per_s": 0.5,
        "read_noise_adu": 0.6,
        "fixed_pattern_adu": 0.1,
        "hot_pixels": ((7, 9, 0.0, 30.0),),
    }
    return DarkCalibration(**(header() | values | changes))


def axis(**changes):
    values = {
        "kind": "axis",
        "axis_px": (1275.5, 961.25),
        "covariance_px2": ((0.01, 0.0), (0.0, 0.02)),
        "method": "run",
    }
    return AxisCalibration(**(header() | values | changes))


def config_file(folder, calibrations, more=""):
    """FACT's config in `folder`, naming these calibration files for the star camera."""
    names = []
    for calibration in calibrations:
        name = f"{calibration.kind}_{len(names)}.json"
        (folder / name).write_text(calibration_to_json(calibration))
        names.append(name)
    path = folder / "telescope.toml"
    path.write_text(f'extends = "fact"\n[star_camera]\ncalibrations = {json.dumps(names)}\n{more}\n')
    return path


def refusal(path, now=NOW):
    with pytest.raises(ConfigError) as caught:
        load_config(path, now=now)
    return str(caught.value)


@pytest.mark.parametrize("make", [geometry, radiometric, dark, axis])
def test_what_is_written_is_read(tmp_path, make):
    path = tmp_path / "calibration.json"
    write_calibration(path, make())
    assert read_calibration(path) == make()
    with pytest.raises(ConfigError, match="exists"):
        write_calibration(path, make())
    shown = CliRunner().invoke(app, ["calibrate", "show", str(path)])
    assert shown.exit_code == 0
    assert "IDS UI-1480SE-M" in shown.output
    assert "12 frames of a lamp" in shown.output


def test_all_of_them_take_the_place_of_what_the_config_says(tmp_path):
    config = load_config(config_file(tmp_path, [geometry(), radiometric(), dark(), axis()]), now=NOW)
    camera = build_instrument(config).star_camera
    assert rad_to_mdeg(camera.plate_scale_rad) == pytest.approx(2.4401)
    assert camera.orientation.rotation_rad == pytest.approx(deg_to_rad(12.5))
    assert camera.orientation.is_mirrored
    assert camera.law.r_curve == 0.03
    assert camera.saturation_share == 0.95
    assert camera.dark is not None
    assert camera.dark.level_adu(2.0) == pytest.approx(6.0)
    np.testing.assert_array_equal(camera.dark.hot_pixels, [[7, 9]])
    np.testing.assert_allclose(camera.theta_of_pixel(np.array([1275.5, 961.25])), 0.0, atol=1e-15)
    stored = InstrumentConfig.from_json(config.to_json(), "run")  # long after they expired, without their files
    again = build_instrument(stored).star_camera
    assert again.law == camera.law
    assert again.plate_scale_rad == camera.plate_scale_rad


def test_what_a_method_cannot_tell_stays_as_the_config_says(tmp_path):
    bare = geometry(rotation_deg=None, rotation_uncertainty_deg=None, mirrored=None, distortion=None)
    camera = build_instrument(load_config(config_file(tmp_path, [bare]), now=NOW)).star_camera
    nominal = build_instrument(load_config("fact")).star_camera
    assert camera.orientation == nominal.orientation
    assert camera.distortion is None
    assert camera.plate_scale_rad != nominal.plate_scale_rad


def test_an_expired_calibration_is_refused_unless_told_otherwise(tmp_path):
    later = NOW + timedelta(days=366)
    path = config_file(tmp_path, [geometry()])
    load_config(path, now=NOW + timedelta(days=364))
    text = refusal(path, later)
    assert "star_camera.calibrations" in text
    assert "expired on 2027-11-22" in text
    load_config(config_file(tmp_path, [geometry()], 'accept_calibrations = ["expired"]'), now=later)


@pytest.mark.parametrize(
    ("in_file", "in_config", "is_foreign"),
    [
        ("4103", 'serial_number = "4103"', False),
        ("4103", 'serial_number = "4104"', True),
        ("4103", "", False),  # the config does not know its camera's number: the model is all that can tell
        (None, 'serial_number = "4103"', False),
        ("twin, seed 3", "", True),
        ("twin, seed 3", 'serial_number = "4103"', True),
    ],
)
def test_a_calibration_of_another_camera_is_foreign(tmp_path, in_file, in_config, is_foreign):
    path = config_file(tmp_path, [geometry(serial_number=in_file)], in_config)
    if not is_foreign:
        load_config(path, now=NOW)
        return
    assert "foreign" in refusal(path)
    accepting = in_config + '\naccept_calibrations = ["foreign"]'
    load_config(config_file(tmp_path, [geometry(serial_number=in_file)], accepting), now=NOW)


@pytest.mark.parametrize(
    ("calibrations", "words"),
    [
        ([geometry(model="another camera")], "foreign"),
        ([geometry(), geometry(plate_scale_mdeg_per_px=2.5)], "2 calibrations are of the kind geometry"),
        ([geometry(columns=1280)], "images of 1280 x 1920"),
        ([geometry(camera="reflector_camera")], "of the reflector_camera"),
    ],
)
def test_calibrations_that_do_not_belong_are_refused(tmp_path, calibrations, words):
    assert words in refusal(config_file(tmp_path, calibrations))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such calibration file"),
        ("{", "not readable as JSON"),
        ("[]", "is no calibration file"),
        ('{"schema": "namod-alignment/1"}', "is no calibration file"),
        ('{"schema": "namod-calibration/1"}', "kind"),
        (calibration_to_json(geometry()).replace("2.4401", '"2.4401"'), "plate_scale_mdeg_per_px"),
        (calibration_to_json(geometry()).replace('"method"', '"methods"'), "methods"),
        (calibration_to_json(geometry()).replace("2027", "2025"), "valid_until_utc must be later"),
        (calibration_to_json(geometry()).replace("+00:00", ""), "time zone"),
        (calibration_to_json(dark()).replace("7,", "2560,"), "hot pixel (2560, 9) lies outside"),
        (calibration_to_json(geometry()).replace("-0.3333", "-40.0").replace("2.4401", "24.401"), "folds"),
    ],
)
def test_files_that_are_none_are_refused_with_their_key(tmp_path, text, words):
    path = tmp_path / "calibration.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_calibration(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


ANY_JSON = st.recursive(
    st.none() | st.floats() | st.text(), lambda inner: st.dictionaries(st.text(), inner), max_leaves=5
).map(json.dumps)


@given(st.text(max_size=200) | ANY_JSON)
def test_no_text_is_read_as_a_calibration_or_breaks_the_reader(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("any") / "any.json"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    with pytest.raises(ConfigError):
        read_calibration(path)


def test_a_bad_place_is_refused_before_anything_is_measured(tmp_path):
    with pytest.raises(ConfigError, match="is a folder"):
        check_calibration_output(tmp_path, force=True)
    with pytest.raises(ConfigError, match="does not exist"):
        check_calibration_output(tmp_path / "no" / "such.json", force=True)
    for days in (0.0, -1.0, 1e6, float("nan")):
        with pytest.raises(ConfigError, match="valid-days"):
            new_header(load_config("fact").star_camera, "star_camera", Clock(), source="", valid_days=days)


def test_files_named_by_a_base_lie_beside_the_base(tmp_path):
    (tmp_path / "site").mkdir()
    base = config_file(tmp_path, [geometry()])
    text = (builtin_folder() / "fact.toml").read_text()
    assert "calibrations" not in text
    upper = tmp_path / "site" / "upper.toml"
    upper.write_text(f'extends = "{base}"\n')
    camera = build_instrument(load_config(upper, now=NOW)).star_camera
    assert rad_to_mdeg(camera.plate_scale_rad) == pytest.approx(2.4401)
