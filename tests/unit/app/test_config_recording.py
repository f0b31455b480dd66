"""The section `[recording]` of an instrument's config: what it sets, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, load_config
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.record import RecordSettings


def config_with(section: str, folder: Path) -> InstrumentConfig:
    """Mini FACT's config with that section."""
    path = folder / "it.toml"
    path.write_text((builtin_folder() / "mini_fact.toml").read_text() + "\n[recording]\n" + section)
    return load_config(path)


def test_without_the_section_everything_has_its_default_and_stored_configs_are_as_they_were() -> None:
    config = load_config("fact")
    assert build_record_settings(config) == RecordSettings()
    assert "recording" not in config.to_json()


def test_what_is_set_is_used_and_stored(tmp_path: Path) -> None:
    config = config_with(
        "brightest_pixel_share = 0.6\nmax_motion_share = 0.25\nshortest_exposure_s = 0.002\n"
        "longest_exposure_s = 1.5\nstar_zero_point_mag = -3.2\n",
        tmp_path,
    )
    expected = RecordSettings(
        target_share=0.6, max_motion_share=0.25, shortest_s=0.002, longest_s=1.5, star_zero_point_mag=-3.2
    )
    assert build_record_settings(config) == expected
    assert build_record_settings(InstrumentConfig.from_json(config.to_json(), "stored")) == expected


@pytest.mark.parametrize(
    ("section", "says"),
    [
        (
            "brightest_pixel_share = 80.0",
            "recording.brightest_pixel_share = 80.0 is not plausible, must be at most 0.95",
        ),
        ("brightest_pixel_share = 0.1", "recording.brightest_pixel_share = 0.1 is not plausible, must be at least 0.3"),
        ("max_motion_share = -1.0", "recording.max_motion_share = -1.0 is not plausible, must be at least 0.05"),
        ("longest_exposure_s = 3000.0", "recording.longest_exposure_s = 3000.0 is not plausible, must be at most 600"),
        ("longest_exposure_ms = 3000.0", "convert it and write longest_exposure_s"),
        ("shortest_exposure_s = 5.0", "shortest_exposure_s = 5 is more than longest_exposure_s = 3"),
        ("zero_point = 5.0", "recording.zero_point: unknown key"),
    ],
)
def test_a_bad_value_is_refused_with_key_value_and_limit(section: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        config_with(section, tmp_path)
    assert says in str(refused.value)
    assert "it.toml" in str(refused.value)


def test_a_target_beyond_saturation_is_refused(tmp_path: Path) -> None:
    text = (
        (builtin_folder() / "mini_fact.toml").read_text().replace("saturation_share = 0.98", "saturation_share = 0.7")
    )
    path = tmp_path / "it.toml"
    path.write_text(text + "\n[recording]\nbrightest_pixel_share = 0.75\n")
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    assert "recording.brightest_pixel_share = 0.75 must be less than star_camera.saturation_share = 0.7" in str(
        refused.value
    )
