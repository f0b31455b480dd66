"""Configs that extend another: what is laid over what, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.core.errors import ConfigError


def test_a_base_in_another_folder_keeps_its_files(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    for path in builtin_folder().glob("fact*.*"):
        shutil.copy(path, tmp_path / "base")
    (tmp_path / "mine.toml").write_text('extends = "base/fact_actuated.toml"\n[telescope]\nname = "mine"\n')
    mine, fact = load_config(tmp_path / "mine.toml"), load_config("fact_actuated")
    assert mine.telescope.name == "mine"
    assert mine.telescope.focal_length_m == fact.telescope.focal_length_m
    assert (mine.facets, mine.polygons, mine.actuators) == (fact.facets, fact.polygons, fact.actuators)


def test_lists_replace_and_a_table_of_another_kind_replaces() -> None:
    base, other = load_config("fact_actuated"), load_config("fact_modbus_rtu")
    assert base.mount.kind == "tripod"
    assert base.mount.backlash_um == 10.0
    assert base.mount.pitch_mm_per_turn == 1.0  # of fact.toml, laid over
    assert other.mount.kind == "legs"
    assert other.mount.pitch_mm_per_turn is None
    assert other.actuators is not None
    assert [bus.protocol for bus in other.actuators.buses] == ["modbus_rtu", "modbus_rtu"]


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({"it": 'extends = "it.toml"'}, "extends = 'it.toml' leads back to it.toml"),
        ({"it": 'extends = "a.toml"', "a": 'extends = "it.toml"'}, "leads back to it.toml"),
        ({"it": "extends = 3"}, "extends = 3 must be the name of one config in quotes"),
        ({"it": 'extends = "none.toml"'}, "extends: none.toml: there is no such config file"),
        ({"it": 'extends = "a.toml"', "a": "[telescope"}, "a.toml: not valid TOML"),
        ({"it": 'extends = "fact"\n[mount]\nradius_mm = 3'}, "it.toml (extends fact): mount.radius_mm"),
        ({"it": 'extends = "fact"\nmount = 3'}, "mount"),
        ({"it": 'extends = "a/a.toml"', "a/a": "actuators = {buses = 3}\nreflector = {facets_file = 4}"}, "actuators"),
        ({"it": 'actuators = 3\nextends = "a/a.toml"', "a/a": "actuators = 3\nreflector = 4"}, "actuators"),
    ],
)
def test_a_bad_base_is_refused(files: dict[str, str], says: str, tmp_path: Path) -> None:
    for name, text in files.items():
        path = tmp_path / f"{name}.toml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_config(tmp_path / "it.toml")
    assert says in str(refused.value)
