"""The frames that a run has kept, measured anew into another run: of a replay, and of newer calibrations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.records import Record
from namod_ctl.cycle.record import Equipment
from namod_ctl.cycle.replay import CAMERAS, ReplayCamera, ReplayClock
from namod_ctl.store.folders import check_output, discard, free_sibling, put_in_place
from namod_ctl.store.run import RunStore


def replay_equipment(old: RunStore, records: list[Record]) -> Equipment:
    """Cameras that show the frames of these records of an open run, one after the other."""
    star, reflector = (ReplayCamera(old, records, camera) for camera in CAMERAS)
    return Equipment(star, reflector, ReplayClock(), SystemClock())


@contextmanager
def new_run_of(old: RunStore, out: Path, config_json: str, source: str, *, force: bool) -> Iterator[RunStore]:
    """A run that is put at `out` when the block is done: one that fails leaves nothing and replaces nothing.

    Raises
    ------
    ConfigError
        `out` may not be written, or is the old run itself.
    """
    out = out.resolve()
    if out == old.path:
        raise ConfigError(f"--out {out}: is the run itself, which stays as it is; choose another")
    check_output(out, force=force)
    built = free_sibling(out)
    try:
        with RunStore.create(built, old.facet_ids, config_json, source, SystemClock()) as store:
            yield store
        put_in_place(built, out, force=force)
    except BaseException:
        discard(built)
        raise
