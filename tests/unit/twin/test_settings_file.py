"""Settings of the twin from a file a person wrote."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from namod_ctl.app.build.twin import build_twin, load_twin_settings
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.twin.faults import CATALOGUE, DRIVE_CATALOGUE
from namod_ctl.twin.settings import REFLECTOR_CAMERA, FaultSpec, Limits, TwinSettings

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
        ("[telescope]\nspeed_arcmin_per_s = 0.0", "telescope.speed_arcmin_per_s = 0.0: must be from 0.0001667 to 300"),
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


NONSENSE = """
aperture_radius_m = 0
[reflector]
misalignment_deg = 40
misalignment_rad = 0.001
roughness_rad = -3
reflectivity = 0
[sky]
extinction_mag = -1
scintillation = -1
[telescope]
radius_deg = 60
jitter_arcmin = -1.0
centre_deg = [0.0, 50.0]
wind = 3
[star_camera]
n_hot_pixels = -1
read_noise_adu = -1
latency_s = 9
exposure_range_s = [-1.0, 3.0]
[[faults]]
name = "clouds"
start_s = -5.0
params = { factor = -3.0, period_s = 0 }
[[faults]]
name = "twilight"
params = { rise_s = 0 }
[[faults]]
name = "dew"
params = { decay_s = 0, floor = -1 }
[[faults]]
name = "aircraft"
params = { blink_s = 0, miss_deg = 100 }
[[faults]]
name = "torn_frame"
params = { share = 7 }
[[faults]]
name = "hot_pixels"
params = { count = 1e11 }
"""


def test_all_nonsense_is_told_together_with_key_value_and_limits_as_they_are_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        settings_of(NONSENSE, tmp_path)
    lines = str(refused.value).splitlines()
    assert all("twin.toml: " in line for line in lines)
    told = {line.split("twin.toml: ")[1].split(":")[0] for line in lines}
    assert told == {
        "aperture_radius_m = 0",
        "reflector.misalignment_deg = 40",
        "reflector.misalignment_rad = 0.001",
        "reflector.roughness_rad = -3",
        "reflector.reflectivity = 0",
        "sky.extinction_mag = -1",
        "sky.scintillation = -1",
        "telescope.radius_deg = 60",
        "telescope.jitter_arcmin = -1.0",
        "telescope.centre_deg = [0.0, 50.0]",
        "telescope.wind = 3",
        "star_camera.n_hot_pixels = -1",
        "star_camera.read_noise_adu = -1",
        "star_camera.latency_s = 9",
        "star_camera.exposure_range_s = [-1.0, 3.0]",
        "faults.0.start_s = -5.0",
        "faults.0.params.factor = -3.0",
        "faults.0.params.period_s = 0",
        "faults.1.params.rise_s = 0",
        "faults.2.params.decay_s = 0",
        "faults.2.params.floor = -1",
        "faults.3.params.blink_s = 0",
        "faults.3.params.miss_deg = 100",
        "faults.4.params.share = 7",
        "faults.5.params.count = 100000000000.0",
    }
    assert any("radius_deg = 60: must be from 0.001667 to 5" in line for line in lines)
    assert any("misalignment_rad = 0.001: is given a second time, as misalignment_deg" in line for line in lines)


def numbers_of(kind: type, path: str = "") -> Iterator[tuple[str, object]]:
    for key, hint in get_type_hints(kind, include_extras=True).items():
        if is_dataclass(hint) and isinstance(hint, type):
            yield from numbers_of(hint, f"{path}{key}.")
        else:
            yield f"{path}{key}", hint


def test_every_number_has_limits_which_its_default_keeps(tmp_path: Path) -> None:
    names = {"star_changes", "reference_star", "pattern", "faults", "__pydantic_config__"}
    for kind in (TwinSettings, FaultSpec):
        for name, hint in numbers_of(kind):
            if name.split(".")[-1] not in names | {"name", "params"}:
                assert any(isinstance(extra, Limits) for extra in get_args(hint)), name
    text = "".join(
        f"[[faults]]\nname = {name!r}\nparams = {{ {', '.join(f'{k} = {v!r}' for k, v in kind.defaults.items())} }}\n"
        for name, kind in CATALOGUE.items()
    )
    assert len(settings_of(text, tmp_path).faults) == len(CATALOGUE)
    lines = [
        f"[{section.name}]\n" + "".join(f"{f.name} = {list(v) if isinstance(v, tuple) else v!r}\n" for f, v in values)
        for section in fields(TwinSettings)
        if is_dataclass(own := getattr(TwinSettings(), section.name))
        for values in [[(f, getattr(own, f.name)) for f in fields(own)]]
    ]
    assert settings_of("".join(lines), tmp_path) == TwinSettings()


@pytest.mark.parametrize("least", [True, False])
def test_a_twin_at_the_limits_of_its_faults_can_be_recorded(tmp_path: Path, least: bool) -> None:
    """What the limits let pass makes no traceback, late in the night either."""
    faults = []
    for name in set(CATALOGUE) - set(DRIVE_CATALOGUE):
        kind = CATALOGUE[name]
        limits = {key: kind.limits_of(key) for key in kind.defaults}
        faults.append(FaultSpec(name, params={k: x.least if least else x.most for k, x in limits.items() if x}))
    twin = build_twin(load_config("mini_fact"), TwinSettings(faults=tuple(faults)), 3)
    for time_s in (0.0, 30000.0):
        twin.update(time_s)
        twin.sky.tracks(time_s, time_s + 1.0, 1e-4, 100)
        assert math.isfinite(twin.sky.background(time_s)[0])
        for camera in (twin.star_camera, twin.reflector_camera):
            with suppress(CommunicationError, DeviceFaultError):
                camera.start(0.01)
                camera.fetch(2.0)
