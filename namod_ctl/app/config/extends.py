"""Configs that build on another: `extends = "fact.toml"` at the top of a file.

The file's tables are laid over those of its base, key by key and table in table; everything that is no table (a list,
too) takes the place of what the base says. A table whose `kind` or `driver` differs from the base's takes its place as
a whole: the base's keys would mean nothing in it. A base may itself extend another.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.table_text import read_text

KEY = "extends"
_KINDS = ("kind", "driver")


def read_extended(path: Path, find_base: Callable[[str], Path]) -> tuple[dict[str, Any], str]:
    """The tables of a config laid over those of its bases, and what to call their source in errors.

    `find_base` finds a base that does not lie beside the file which names it.

    Raises
    ------
    ConfigError
        A file is absent or no TOML, or the bases go round in a circle.
    """
    raw, names = _read(path, find_base, ())
    return raw, f"{path} (extends {', '.join(names)})" if names else str(path)


def _read(path: Path, find_base: Callable[[str], Path], above: tuple[Path, ...]) -> tuple[dict[str, Any], list[str]]:
    try:
        raw = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # of syntax, a number of thousands of digits, endless nesting
        raise ConfigError(f"{path}: not valid TOML: {error}") from None  # it names line and column
    name = raw.pop(KEY, None)
    if name is None:
        return raw, []
    if not isinstance(name, str):
        raise ConfigError(f"{path}: {KEY} = {name!r} must be the name of one config in quotes")
    above = (*above, path.resolve())
    try:
        beside = path.parent / name
        base_path = beside if beside.is_file() else find_base(name)
    except ConfigError as problem:
        raise ConfigError(f"{path}: {KEY}: {problem}") from None
    if base_path.resolve() in above:
        raise ConfigError(f"{path}: {KEY} = {name!r} leads back to {base_path.name}: take it out of one of the files")
    base, names = _read(base_path, find_base, above)
    if base_path.parent.resolve() != path.parent.resolve():
        _name_files_from(base, base_path.parent.resolve())
    return _laid_over(base, raw), [name, *names]


def _laid_over(base: Mapping[str, Any], upper: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in upper.items():
        below = merged.get(key)
        if (
            isinstance(value, dict)
            and isinstance(below, dict)
            and all(value.get(name, below.get(name)) == below.get(name) for name in _KINDS)
        ):
            merged[key] = _laid_over(below, value)
        else:
            merged[key] = value
    return merged


def _name_files_from(raw: dict[str, Any], folder: Path) -> None:
    """Files that a base names lie beside it, not beside what extends it."""
    actuators = raw.get("actuators")
    buses = actuators.get("buses") if isinstance(actuators, dict) else None
    tables = [(raw.get("reflector"), "facets_file"), (raw.get("reflector_map"), "polygons_file")]
    tables += [(bus, "drive_map") for bus in (buses if isinstance(buses, list) else [])]
    for camera in ("star_camera", "reflector_camera", "psf_camera"):
        section = raw.get(camera)
        if not isinstance(section, dict):
            continue
        device, files = section.get("device"), section.get("calibrations")
        if isinstance(files, list):
            section["calibrations"] = [str(folder / name) if isinstance(name, str) else name for name in files]
        if isinstance(device, dict) and device.get("driver") == "folder" and isinstance(device.get("address"), str):
            device["address"] = str(folder / Path(device["address"]).expanduser())  # may come into being later
    for table, key in tables:
        if isinstance(table, dict) and isinstance(table.get(key), str) and (folder / table[key]).is_file():
            table[key] = str(folder / table[key])
