"""How to get a result again: the commands, and the config and the twin as files."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass

from namod_ctl.app.build.twin_note import NOTE_SETTINGS, Notes, different_sections, noted_twin
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_names, load_config
from namod_ctl.app.report.document import Block, Chapter, Listing, Text
from namod_ctl.app.report.toml_text import to_toml
from namod_ctl.core.errors import ConfigError
from namod_ctl.twin.settings import TwinSettings

CONFIG_FILE, TWIN_FILE = "used_config.toml", "used_twin.toml"


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a result comes from.

    Attributes
    ----------
    options
        Of the commands that begin a recording: the config and, for a twin, its seed and settings.
    seed
        Of the twin; None for a real telescope.
    twin_words
        What the twin is, for people; empty for a real telescope.
    files
        By name, to be written beside the report.
    """

    options: str
    seed: int | None
    twin_words: str
    files: Mapping[str, bytes]


def origin_of(store: Notes, config: InstrumentConfig) -> Origin:
    """The origin of a run or campaign of that config."""
    builtin = _builtin_of(config)
    options = [f"--config {builtin or CONFIG_FILE}"]
    files = {CONFIG_FILE: to_toml(config.model_dump(exclude_none=True, mode="json")).encode()}
    noted = noted_twin(store)
    if noted is None:
        return Origin(options[0], None, "", files)
    settings, seed = noted
    options.append(f"--seed {seed}")
    words = f"digital twin, seed {seed}, "
    if different := different_sections(settings, TwinSettings()):
        options.append(f"--twin-settings {TWIN_FILE}")
        files[TWIN_FILE] = to_toml(json.loads(store.note(NOTE_SETTINGS) or "{}")).encode()
        words += f"with settings of its own for {', '.join(name.replace('_', ' ') for name in different)}"
    else:
        words += "with the program's own settings"
    return Origin(" ".join(options), seed, words, files)


def _builtin_of(config: InstrumentConfig) -> str | None:
    """Name of the config that comes with the program and says the same."""
    for name in builtin_names():
        try:
            if load_config(name) == config:
                return name
        except ConfigError:
            continue  # a file somebody put there; it cannot be what was used
    return None


def reproduce_chapter(origin: Origin, commands: tuple[str, ...], version: str, config_json: str) -> Chapter:
    """The chapter with the commands."""
    blocks: list[Block] = [
        Text(f"With namod-ctl {version}, in a folder that holds the files written beside this report:"),
        Listing(commands),
        Text(
            f"Files beside this report: {', '.join(origin.files)}. The config as stored has the SHA-256 "
            f"{hashlib.sha256(config_json.encode()).hexdigest()}."
        ),
    ]
    return Chapter("How to get this result again", tuple(blocks))


def quoted(path: object) -> str:
    """A path as it is typed in a shell."""
    return shlex.quote(str(path))
