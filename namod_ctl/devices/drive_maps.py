"""Register maps of Modbus drives: the table of a file as it is, and what it means."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import namod_ctl
from firmware_protocols.modbus_drive import RegisterMap
from firmware_protocols.modbus_map import RegisterMapError, read_register_map
from namod_ctl.core.errors import ConfigError

__all__ = ["RegisterMap", "builtin_map_names", "drive_map_of", "load_register_map", "read_drive_map"]


def builtin_map_names() -> list[str]:
    """Names of the register maps that come with the program, such as `cia402`."""
    return sorted(path.stem for path in _builtin_folder().glob("*.toml"))


def load_register_map(path_or_builtin_name: str | Path) -> RegisterMap:
    """The register map of a TOML file or a built-in name. Raises ConfigError as the functions below."""
    name = str(path_or_builtin_name)
    return drive_map_of(read_drive_map(name, Path(), _builtin_folder()), name)


def read_drive_map(name: str, folder: Path, builtin_folder: Path) -> dict[str, Any]:
    """The table of a register map: of a file, named relative to `folder`, or else of a built-in name.

    Raises
    ------
    ConfigError
        There is no such file, or it is no TOML.
    """
    path = folder / name
    known = sorted(builtin.stem for builtin in builtin_folder.glob("*.toml"))
    if not path.is_file() and name in known:
        path = builtin_folder / f"{name}.toml"
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"{path}: no readable register map ({error.strerror}); give the path of a TOML file or a built-in name: "
            f"{', '.join(known)}"
        ) from None
    except (ValueError, RecursionError) as error:  # of encoding, syntax, endless nesting
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def drive_map_of(table: Mapping[str, Any], source: str) -> RegisterMap:
    """What the table of a register map means; `source` names it in errors.

    Raises
    ------
    ConfigError
        All that is wrong with it, each problem on a line of its own.
    """
    try:
        return read_register_map(dict(table))
    except RegisterMapError as error:
        raise ConfigError("\n".join(f"{source}: {problem}" for problem in error.problems)) from None


def _builtin_folder() -> Path:
    """Inside the installed package, or beside it in a checkout."""
    package = Path(namod_ctl.__file__).parent
    inside = package / "config"
    return (inside if inside.is_dir() else package.parent / "config") / "drives"
