"""Runs of one telescope become one: checked against each other, put on one scale, and written as a new run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin_note import NOTE_SEED, NOTE_SETTINGS
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.cycle.record import SESSION_GAP_S
from namod_ctl.reconstruction.reconstruct import MIN_RECORDS, expected_size_rad
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.reconstruction.run_comparison import RunComparison, compare_runs
from namod_ctl.store.combine import NOTE_COMBINED, RunPart, check_combined_output, merge_records, new_combined_run
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import TwinSettings

_MAX_DIFFERENCES = 8


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One of the runs, read."""

    part: RunPart
    config: InstrumentConfig
    config_json: str
    made: datetime
    twin: str
    """Which twin it was recorded with, for comparison; empty without one."""


@contextmanager
def combined_run(paths: Sequence[Path], out: Path, clock: Clock, *, force: bool) -> Iterator[Path]:
    """Folder of a run of all records of the runs at `paths`, which is put at `out` when the block is done.

    The runs follow each other in the order in which they were made; the config is that of the last one. A run whose
    responses are significantly larger or smaller than those of the run with most records has its facets'
    intensities divided by that factor.

    Raises
    ------
    ConfigError
        A run is missing, named twice, a copy or a combination of others, or of another telescope; `out` may not be
        written.
    DataQualityError
        Too few records, no light, or facets that moved between the runs.
    """
    runs = _read(paths, out)
    check_combined_output(out.resolve(), force=force)
    newest = runs[-1]
    _refuse_other_telescopes(runs)
    facet_ids = newest.part.facet_ids
    merged = merge_records([run.part for run in runs], facet_ids, SESSION_GAP_S)
    comparisons = _compare(merged, facet_ids, newest.config)
    _refuse_moved_mirror(runs, comparisons)
    records = [
        record if factor is None else replace(record, facet_intensity=record.facet_intensity / factor)
        for part, factor in zip(merged, map(_applied_factor, comparisons), strict=True)
        for record in part
    ]
    lines = [
        _description(run.part, part, comparison)
        for run, part, comparison in zip(runs, merged, comparisons, strict=True)
    ]
    with new_combined_run(
        out,
        records,
        facet_ids=facet_ids,
        config_json=newest.config_json,
        source="combined from " + ", ".join(run.part.name for run in runs),
        note="\n".join(lines),
        clock=clock,
        force=force,
    ) as folder:
        yield folder


def _applied_factor(comparison: RunComparison | None) -> float | None:
    """What a run's intensities are to be divided by; None for a run that is left as it is."""
    return comparison.factor if comparison is not None and comparison.is_factor_significant else None


def _read(paths: Sequence[Path], out: Path) -> list[_Run]:
    """All runs in the order in which they were made."""
    resolved = [path.resolve() for path in paths]
    for i, path in enumerate(resolved):
        if path == out.resolve():
            raise ConfigError(f"--out {out}: is one of the runs, which stay as they are; choose another")
        if path in resolved[:i]:
            raise ConfigError(f"{paths[i]}: is named twice; every run counts once")
    is_unique = len({path.name for path in resolved}) == len(resolved)
    runs = []
    with ExitStack() as stack:
        for path, given in zip(resolved, paths, strict=True):
            store = stack.enter_context(RunStore.open(path))
            made_of = store.note(NOTE_COMBINED)
            if made_of is not None:
                raise ConfigError(
                    f"{given}: is itself a combination; name its runs instead, so that each counts once:\n{made_of}"
                )
            part = RunPart(path.name if is_unique else str(given), store.facet_ids, tuple(store.records()))
            config = InstrumentConfig.from_json(store.config_json, f"{given}: config")
            made = datetime.fromisoformat(store.created_utc)
            runs.append(_Run(part, config, store.config_json, made, _twin_in_words(store)))
    return sorted(runs, key=lambda run: run.made)


def _twin_in_words(store: RunStore) -> str:
    """Seed and mirror of the twin that a run was recorded with; another one is another telescope."""
    seed, settings = store.note(NOTE_SEED), store.note(NOTE_SETTINGS)
    if seed is None:
        return ""
    reflector = {} if settings is None else json.loads(settings).get("reflector", {})
    default = asdict(TwinSettings().reflector)
    changed = [f"{key} = {value}" for key, value in reflector.items() if value != default.get(key)]
    return ", ".join([f"seed {seed}", *changed])


def _refuse_other_telescopes(runs: Sequence[_Run]) -> None:
    """Cameras may differ, for every record carries what its own calibration gave; the mirror may not."""
    newest = runs[-1]
    problems = []
    for run in runs[:-1]:
        if run.twin and newest.twin and run.twin != newest.twin:
            problems.append(f"{run.part.name}: is of the twin of {run.twin}, {newest.part.name} of {newest.twin}")
        only = set(run.part.facet_ids) ^ set(newest.part.facet_ids)
        if only:
            problems.append(
                f"{run.part.name}: facet ids {', '.join(map(str, sorted(only)))} are in only one of it and "
                f"{newest.part.name}"
            )
        here, there = (dict(_mirror(a.config)) for a in (run, newest))
        keys = [key for key in here | there if here.get(key) != there.get(key)]
        problems += [
            f"{run.part.name}: {key} is {here.get(key, 'absent')}, in {newest.part.name} {there.get(key, 'absent')}"
            for key in keys[:_MAX_DIFFERENCES]
        ]
        if len(keys) > _MAX_DIFFERENCES:
            problems.append(f"{run.part.name}: ... and {len(keys) - _MAX_DIFFERENCES} more values differ")
    if problems:
        raise ConfigError(
            "\n".join(problems)
            + "\nonly runs of one telescope combine (its cameras may differ): leave the odd run out, or import it "
            "again with the right config"
        )


def _mirror(config: InstrumentConfig) -> Iterator[tuple[str, Any]]:
    """Keys and values of the config that belong to telescope, facets and mounts."""
    sections = config.model_dump()
    yield from ((f"telescope.{key}", value) for key, value in sections["telescope"].items())
    yield from ((f"mount.{key}", value) for key, value in sections["mount"].items())
    for facet in sections["reflector"]["facets"]:
        yield from ((f"facet {facet['id']}: {key}", value) for key, value in facet.items())


def _compare(
    merged: Sequence[Sequence[Record]], facet_ids: Sequence[int], config: InstrumentConfig
) -> list[RunComparison | None]:
    """Each run beside the one with most records; None for a run without any that counts."""
    table = tabulate_responses([record for part in merged for record in part], facet_ids)
    if table.n_records < MIN_RECORDS:
        raise DataQualityError(
            f"{table.n_records} records of all runs count, at least {MIN_RECORDS} are needed: record longer"
        )
    ends = np.cumsum([len(part) for part in merged])  # indices count from 0 through all parts
    part_of_record = np.searchsorted(ends, table.record_index, side="right")
    present, run_of_record, counts = np.unique(part_of_record, return_inverse=True, return_counts=True)
    expected_rad = expected_size_rad(build_instrument(config))
    found = compare_runs(table, run_of_record, int(np.argmax(counts)), expected_rad)
    comparisons: list[RunComparison | None] = [None] * len(merged)
    for part, comparison in zip(present.tolist(), found, strict=True):
        comparisons[part] = comparison
    return comparisons


def _refuse_moved_mirror(runs: Sequence[_Run], comparisons: Sequence[RunComparison | None]) -> None:
    for run, comparison in zip(runs, comparisons, strict=True):
        if comparison is not None and comparison.is_other_mirror:
            raise DataQualityError(
                f"{run.part.name}: its facets stand elsewhere than in the other runs (by "
                f"{rad_to_arcmin(comparison.distance_rad):.1f} arcmin, the median of {comparison.n_compared} facets): "
                "is it another telescope, were bolts turned, or was the star camera touched in between? Only runs of "
                "the mirror as it is now belong together: leave the older ones out"
            )


def _description(part: RunPart, merged: Sequence[Record], comparison: RunComparison | None) -> str:
    where = f"records {merged[0].index} to {merged[-1].index}" if merged else "no records"
    return f"{part.name}: {where}; {_scale_text(comparison)}{_moved_text(comparison)}"


def _scale_text(comparison: RunComparison | None) -> str:
    if comparison is None:
        return "none of its records counts"
    if comparison.factor_uncertainty == 0.0:
        return "its responses are the scale of the others"
    if not np.isfinite(comparison.factor):
        return "too little light in common to compare the scale of its responses, which are taken as they are"
    text = f"responses {comparison.factor:.3f} +- {comparison.factor_uncertainty:.3f} times as large"
    return text + (": divided by that" if comparison.is_factor_significant else ", which is no significant difference")


def _moved_text(comparison: RunComparison | None) -> str:
    if comparison is None:
        return ""
    if comparison.is_other_mirror is None:
        return (
            f"; NOT CHECKED whether it is of the same mirror: only {comparison.n_compared} facets were seen well "
            "enough in it and in the others"
        )
    if not comparison.moved_facet_ids:
        return ""
    ids = ", ".join(map(str, comparison.moved_facet_ids))
    return f"; LOOK AT facets {ids}: they seem to stand elsewhere than in the others"
