"""Which twin a run was recorded with: noted in the run, so that the next session goes on with the same one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import TypeAdapter, ValidationError

from namod_ctl.core.errors import StoreError
from namod_ctl.twin.settings import TwinSettings

NOTE_SEED = "record.twin_seed"
NOTE_SETTINGS = "record.twin_settings"


class Notes(Protocol):
    """A run or a campaign, which remember texts by name."""

    path: Path

    def note(self, key: str) -> str | None: ...

    def set_note(self, key: str, text: str) -> None: ...


def note_twin(store: Notes, settings: TwinSettings, seed: int) -> None:
    """Note the twin in the run: all its numbers, so that neither a file nor this program's defaults are needed."""
    store.set_note(NOTE_SETTINGS, json.dumps(settings, default=_plain))
    store.set_note(NOTE_SEED, str(seed))


def noted_twin(store: Notes) -> tuple[TwinSettings, int] | None:
    """Settings and seed of the twin that the run was recorded with; None when it was not recorded with one.

    Raises
    ------
    StoreError
        The note cannot be understood.
    """
    seed, settings = store.note(NOTE_SEED), store.note(NOTE_SETTINGS)
    if seed is None:
        return None
    if settings is None:  # runs of before 0.2 know the seed only: all of them are of the default twin
        return TwinSettings(), int(seed)
    try:
        return TypeAdapter(TwinSettings).validate_json(settings), int(seed)
    except ValidationError as error:
        details = "; ".join(f"{'.'.join(map(str, d['loc']))}: {d['msg']}" for d in error.errors())
        raise StoreError(
            f"{store.path}: the twin noted in this run does not fit this program ({details}); "
            "go on with the version that recorded it, or record a new run"
        ) from None


def different_sections(settings: TwinSettings, other: TwinSettings) -> list[str]:
    """Names of the sections in which two twins differ."""
    return [f.name for f in fields(TwinSettings) if getattr(settings, f.name) != getattr(other, f.name)]


def _plain(value: object) -> Any:
    if is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value)} cannot be noted")
