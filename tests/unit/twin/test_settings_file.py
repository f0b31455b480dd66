"""Settings of the twin from a file a person wrote."""

from __future__ import annotations

from pathlib import Path

import pytest

from namod_ctl.app.build_twin import load_twin_settings
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.twin.settings import REFLECTOR_CAMERA, TwinSettings

CLOUDY = """
[reflector]
misalignment_arcmin = 2.5

[sky]
reference_star = "Arcturus"
star_changes = [[600.0, "Vega"]]

[telescope]
pattern = "random"
centre_deg = [0.1, -0.2]
speed_arcmin_per_s = 2

[reflector_camera]
law_error_per_decade = 0.172

[[faults]]
name = "clouds"
start_s = 30.0
duration_s = 100.0
params = { factor = 10.0 }

[[faults]]
name = "second_star"
params = { offset_x_deg = 0.2 }
"""


def settings_of(text: str, folder: Path) -> TwinSettings:
    path = folder / "twin.toml"
    path.write_text(text)
    return load_twin_settings(path)


def test_what_is_written_is_read_in_its_unit_and_the_rest_keeps_its_default(tmp_path: Path) -> None:
    settings = settings_of(CLOUDY, tmp_path)
    assert settings.reflector.misalignment_rad == pytest.approx(arcmin_to_rad(2.5))
    assert settings.sky.star_changes == ((600.0, "Vega"),)
    assert settings.telescope.centre_rad == pytest.approx((deg_to_rad(0.1), deg_to_rad(-0.2)))
    assert settings.telescope.speed_rad_per_s == pytest.approx(arcmin_to_rad(2.0))
    assert settings.reflector_camera.law_error_per_decade == 0.172
    assert settings.reflector_camera.exposure_at_mag0_s == REFLECTOR_CAMERA.exposure_at_mag0_s
    assert settings.star_camera == TwinSettings().star_camera
    assert [fault.name for fault in settings.faults] == ["clouds", "second_star"]
    assert settings.faults[0].params["factor"] == 10.0
    assert settings.faults[1].params["offset_x_rad"] == pytest.approx(deg_to_rad(0.2))


def test_an_empty_file_is_the_default_twin(tmp_path: Path) -> None:
    assert settings_of("", tmp_path) == TwinSettings()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[reflector]\nmisalinment_rad = 1.0", "misalinment_rad"),
        ("[telescope]\npattern = 'circle'", "telescope.pattern"),
        ("[telescope]\nspeed_arcmin_per_s = 0.0", "speed_arcmin_per_s = 0.0: must be positive"),
        ("[sky]\nextinction_mag = nan", "sky.extinction_mag"),
        ("[sky]\nextinction_mag = 'much'", "sky.extinction_mag"),
        ("[[faults]]\nname = 'rain'", "clouds_total"),
        ("[[faults]]\nname = 'clouds'\nparams = {factr = 3.0}", "factor"),
        ("[sky", "not valid TOML"),
    ],
)
def test_a_mistake_is_named_with_its_file(text: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        settings_of(text, tmp_path)
    assert told in str(refused.value)
    assert "twin.toml" in str(refused.value)
