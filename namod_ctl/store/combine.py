"""Several runs as one: their records, renumbered, in a new run that tells where each came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.records import Record
from namod_ctl.store.folders import check_output, discard, free_sibling, is_run, put_in_place
from namod_ctl.store.run import RunStore

NOTE_COMBINED = "combine.runs"
"""What a combined run is made of, for people: one line per run; other runs do not have this note."""


@dataclass(frozen=True, slots=True)
class RunPart:
    """The records of one run, ascending by index, and the name it has among the runs it is combined with."""

    name: str
    facet_ids: tuple[int, ...]
    records: tuple[Record, ...]


def merge_records(parts: Sequence[RunPart], facet_ids: Sequence[int], gap_s: float) -> list[list[Record]]:
    """The records of each part as they are in the combined run; together they are its records.

    Indices count from 0 through all parts. A label says which run and which record it was, facets are in the order of
    `facet_ids`, and the times of each part begin `gap_s` after the end of the part before, so that the combined run's
    time only ever grows.

    Raises
    ------
    ConfigError
        A record is in two parts: one of them is a copy of the other, and would count twice.
    """
    merged: list[list[Record]] = []
    n_before, end_s = 0, np.nan
    for part in parts:
        order = [part.facet_ids.index(facet_id) for facet_id in facet_ids]
        times_s = np.array([(record.star_mid_exposure_s, record.reflector_mid_exposure_s) for record in part.records])
        known_s = times_s[np.isfinite(times_s)]
        offset_s = end_s + gap_s - known_s.min() if len(known_s) and np.isfinite(end_s) else 0.0
        if len(known_s):
            end_s = known_s.max() + offset_s
        merged.append(
            [
                replace(
                    record,
                    index=n_before + i,
                    label=f"{part.name}/{record.index} {record.label}",
                    facet_intensity=record.facet_intensity[order],
                    facet_saturated_share=record.facet_saturated_share[order],
                    star_mid_exposure_s=record.star_mid_exposure_s + offset_s,
                    reflector_mid_exposure_s=record.reflector_mid_exposure_s + offset_s,
                )
                for i, record in enumerate(part.records)
            ]
        )
        n_before += len(part.records)
    _refuse_copies(parts, merged)
    return merged


def check_combined_output(out: Path, *, force: bool) -> None:
    """Raise ConfigError when no combined run may be put at `out`; with `force`, only an older one is replaced."""
    check_output(out, force=force)
    if is_run(out):
        with RunStore.open(out) as old:
            if old.note(NOTE_COMBINED) is None:
                raise ConfigError(
                    f"{out}: holds a run that is no combination of others; it is not replaced even with --force; "
                    "choose another --out"
                )


@contextmanager
def new_combined_run(
    out: Path,
    records: Sequence[Record],
    *,
    facet_ids: Sequence[int],
    config_json: str,
    source: str,
    note: str,
    clock: Clock,
    force: bool,
) -> Iterator[Path]:
    """Folder of the combined run while it is worked on in the block, after which it is at `out`.

    When the block fails, there is nothing new at `out`, and an older run there is as it was.

    Raises
    ------
    ConfigError
        `out` may not be written, see `check_combined_output`.
    StoreError
        The disk refuses.
    """
    out = out.resolve()
    check_combined_output(out, force=force)
    built = free_sibling(out)
    try:
        with RunStore.create(built, facet_ids, config_json, source, clock) as run:
            run.append(records)
            run.set_note(NOTE_COMBINED, note)
        yield built
        put_in_place(built, out, force=force)
    except BaseException:
        discard(built)
        raise


def _refuse_copies(parts: Sequence[RunPart], merged: Sequence[Sequence[Record]]) -> None:
    """Two measurements never agree to the last bit in the star's direction, its brightness and that of all facets."""
    owner: dict[bytes, tuple[int, int]] = {}
    for k, records in enumerate(merged):
        copies: list[tuple[int, int, int]] = []
        for i, record in enumerate(records):
            if record.reject_reason is not None or not np.any(np.nan_to_num(record.facet_intensity) != 0.0):
                continue  # a dark record of coarse data may well be repeated
            star = np.array([*record.theta_rad, record.star_intensity])
            other, j = owner.setdefault(star.tobytes() + record.facet_intensity.tobytes(), (k, i))
            if other != k:
                copies.append((i, other, j))
        if copies:
            i, other, j = copies[0]
            raise ConfigError(
                f"{parts[k].name}: {len(copies)} of its {len(records)} records are in {parts[other].name} as well "
                f"(its record {parts[k].records[i].index} is record {parts[other].records[j].index} there): "
                "one is a copy of the other; leave one of the two out"
            )
