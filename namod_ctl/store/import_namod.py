"""Import of a folder of the original program: all its frames are measured anew and become a run.

The run is built in a folder beside its place and moves there when it is complete. Every record is committed as
soon as it and all before it are measured, so an import that was stopped or killed can be resumed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import closing
from enum import StrEnum
from pathlib import Path

from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.store.database import store_errors
from namod_ctl.store.folders import check_output, discard, is_run, partial_folder, put_in_place
from namod_ctl.store.measure_files import Measurer, MeasuringContext
from namod_ctl.store.namod_folder import CAMERAS, RecordFiles
from namod_ctl.store.run import RunStore
from namod_ctl.store.summary import ImportSummary, summarize_import
from namod_ctl.store.worker_pool import measure_in_order

_NOTE_INPUT = "import.input"
_NOTE_KEEP_FRAMES = "import.keep_frames"
_WITHOUT_FRAMES = (RejectReason.FILE_MISSING, RejectReason.FILE_CORRUPT)


class KeepFrames(StrEnum):
    """Which frames an import copies into the run."""

    ALL = "all"
    NONE = "none"


def import_namod(
    records: Sequence[RecordFiles],
    out: Path,
    *,
    context: MeasuringContext,
    config_facet_ids: Sequence[int],
    config_json: str,
    clock: Clock,
    n_jobs: int = 1,
    force: bool = False,
    resume: bool = False,
    keep_frames: KeepFrames = KeepFrames.NONE,
    on_progress: Callable[[int], None] = lambda n_done: None,
) -> ImportSummary:
    """Summary of the new run at `out`.

    Parameters
    ----------
    records
        Files of the records, in the order of the run.
    context
        How the frames are measured.
    config_facet_ids
        Facets of the config; those without a polygon are named in the summary.
    config_json
        The config of `context`'s instrument.
    resume
        Go on with the unfinished import beside `out`.
    on_progress
        Called with the number of records committed so far.

    Raises
    ------
    ConfigError
        `out` may not be written, a polygon is wrong, or there is nothing that fits to resume.
    StoreError
        The disk refuses, or a worker died; what was committed can be resumed.
    KeyboardInterrupt
        Likewise; a record in flight is dropped, none is half written.
    """
    out = out.resolve()
    check_output(out, force=force)
    Measurer(context)  # complains about wrong polygons before anything is written
    facet_ids = context.facet_ids
    partial = partial_folder(out)
    if resume and _has_records(partial):
        run = _reopen(partial, records, config_json, keep_frames)
    else:
        run = _begin(partial, records, facet_ids, config_json, keep_frames, clock, force=force or resume)
    n_done = 0
    try:
        with run:
            n_done = len(run.labels())
            on_progress(n_done)
            tasks = list(enumerate(records))[n_done:]
            with closing(measure_in_order(context, tasks, n_jobs)) as measured:
                for record, files in zip(measured, records[n_done:], strict=True):
                    if keep_frames is KeepFrames.ALL:
                        _keep_frames(run, record, files)
                    run.append([record])
                    n_done += 1
                    on_progress(n_done)
            summary = summarize_import(run.records(), facet_ids, config_facet_ids)
    except BaseException:
        if n_done == 0:
            discard(partial)
        raise
    put_in_place(partial, out, force=force)
    return summary


def _begin(
    partial: Path,
    records: Sequence[RecordFiles],
    facet_ids: Sequence[int],
    config_json: str,
    keep_frames: KeepFrames,
    clock: Clock,
    *,
    force: bool,
) -> RunStore:
    if partial.exists() and not force:
        raise ConfigError(f"{partial}: an unfinished import lies here; finish it with --resume or drop it with --force")
    source = f"records of the original program in {records[0].folder.resolve()}"
    run = RunStore.create(partial, facet_ids, config_json, source, clock, force=force)
    run.set_note(_NOTE_INPUT, _fingerprints_json(records))
    run.set_note(_NOTE_KEEP_FRAMES, keep_frames.value)
    return run


def _has_records(partial: Path) -> bool:
    """False for an import that was killed before its first record: it is begun anew. Raises ConfigError without one."""
    if not is_run(partial):
        raise ConfigError(f"{partial}: there is no unfinished import to resume; leave --resume out")
    with RunStore.open(partial, read_only=False) as run:
        return bool(run.labels())


def _reopen(partial: Path, records: Sequence[RecordFiles], config_json: str, keep_frames: KeepFrames) -> RunStore:
    run = RunStore.open(partial, read_only=False)
    try:
        _check_same_import(run, records, config_json, keep_frames)
        run.set_note(_NOTE_INPUT, _fingerprints_json(records))
    except BaseException:
        run.close()
        raise
    return run


def _check_same_import(
    run: RunStore, records: Sequence[RecordFiles], config_json: str, keep_frames: KeepFrames
) -> None:
    remedy = "start anew with --force instead of --resume"
    if run.config_json != config_json:
        raise ConfigError(f"{run.path}: the import began with another config, reflector.cfg or calibration; {remedy}")
    if run.note(_NOTE_KEEP_FRAMES) != keep_frames.value:
        raise ConfigError(
            f"{run.path}: the import began with --keep-frames {run.note(_NOTE_KEEP_FRAMES)}; give the same or {remedy}"
        )
    then = json.loads(run.note(_NOTE_INPUT) or "[]")
    for index, label in run.labels():
        if index >= len(records) or records[index].prefix != label:
            raise ConfigError(f"{run.path}: record {label} was imported, but the folder's records now differ; {remedy}")
        if then[index] != _fingerprint(records[index]):
            raise ConfigError(f"{records[index].config}: a file of this record changed after its import; {remedy}")


def _fingerprint(files: RecordFiles) -> str:
    """What tells that a file of the record was added, removed or changed, without reading it."""
    state = []
    for path in files.all():
        if path.exists():
            status = path.stat()
            state.append((path.name, status.st_size, status.st_mtime_ns))
    return hashlib.sha256(repr(state).encode()).hexdigest()[:16]


def _fingerprints_json(records: Sequence[RecordFiles]) -> str:
    return json.dumps([_fingerprint(files) for files in records])


def _keep_frames(run: RunStore, record: Record, files: RecordFiles) -> None:
    if record.reject_reason in _WITHOUT_FRAMES:
        return
    for camera in CAMERAS:
        with store_errors(files.image(camera)):
            data = files.image(camera).read_bytes()
        run.add_png(record.index, f"{camera}_camera", data)
