"""The report of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from namod_ctl import __version__
from namod_ctl.app.alignment_files import ALIGNMENT_FILE, read_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figures import draw_psf_sum
from namod_ctl.app.pictures.psf_panels import psf_panels
from namod_ctl.app.report.document import Block, Chapter, Document, Picture, Table, Text
from namod_ctl.app.report.parts import (
    area_text,
    bad_record_blocks,
    compact_png,
    config_chapter,
    facet_table,
    flag_blocks,
    map_pictures,
    rejection_table,
    remark_blocks,
    when_text,
)
from namod_ctl.app.report.reproduce import Origin, origin_of, quoted, reproduce_chapter
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR
from namod_ctl.reconstruction.normalization import is_self_calibrated
from namod_ctl.reconstruction.reconstruct import Reconstruction, reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.combine import NOTE_COMBINED
from namod_ctl.store.run import RunStore


def run_report(path: Path) -> tuple[Document, Mapping[str, bytes]]:
    """The report of the run at `path`, and the files that belong beside it.

    What was reconstructed and written as alignment.json is what is reported; a run without it is reconstructed here.
    """
    with RunStore.open(path) as run:
        config = InstrumentConfig.from_json(run.config_json, f"{path}: config")
        instrument = build_instrument(config)
        records = run.records()
        origin = origin_of(run, config)
        stored = read_alignment(path) if (path / ALIGNMENT_FILE).is_file() else None
        estimator = DEFAULT_ESTIMATOR if stored is None else stored.estimator
        is_calibrated = stored is None or is_self_calibrated(stored.remarks)
        was_off = False
        chapters = [_done(run, records, origin)]
        bad: list[Block] = []
        try:
            table = tabulate_responses(records, run.facet_ids)
            result = reconstruct(table, instrument, estimator, self_calibration=is_calibrated)
        except DataQualityError as error:
            chapters.insert(0, Chapter("Result", (Text(f"There is none: {error}", is_warning=True),)))
        else:
            alignment = stored or result.alignment
            was_off = not is_calibrated and result.normalization.is_worth_removing
            bad = bad_record_blocks(alignment.bad_records)
            chapters.insert(0, _result(alignment, result, instrument))
            chapters += [
                Chapter("Facets", (facet_table(alignment), *flag_blocks(alignment.facets))),
                Chapter("Point spread functions and pointings", tuple(map_pictures(result, path.resolve().name))),
            ]
            if remarks := remark_blocks(alignment):
                chapters.append(Chapter("Remarks of the reconstruction", tuple(remarks)))
        choice = "" if estimator == DEFAULT_ESTIMATOR else f" --estimator {estimator}"
        choice += " --no-self-calibration" if was_off else ""
        chapters += [
            Chapter("Records that do not count", (rejection_table([("number", records)]), *bad)),
            config_chapter(config, instrument),
            reproduce_chapter(origin, _commands(path, run, records, origin, choice), __version__, run.config_json),
        ]
        title = f"{run.telescope}: run {path.resolve().name}"
        subtitle = f"Recorded {when_text(run.created_utc)}; {run.source}. Reported by namod-ctl {__version__}."
    return Document(title, subtitle, tuple(chapters)), origin.files


def _result(alignment: Alignment, result: Reconstruction, instrument: Instrument) -> Chapter:
    limit = rad2_to_arcmin2(result.limit.a_sigma_rad2)
    rows = tuple(
        (name, area_text(area), f"{rad2_to_arcmin2(area.a_sigma_rad2) / limit:.2f}")
        for name, area in (
            ("now", alignment.now),
            ("predicted after the correction", alignment.predicted),
            ("limit: ray-traced, the same facets perfectly aligned", result.limit),
        )
    )
    x, y = rad_to_arcmin(alignment.axis_rad)
    blocks: list[Block] = [
        Table(("whole reflector", "A_sigma arcmin²", "times the limit"), rows),
        Text(
            f"{len(alignment.facets)} facets from {alignment.n_used} of {alignment.n_records} accepted records, "
            f"estimator {alignment.estimator}. Corrections aim at ({x:+.2f}, {y:+.2f}) arcmin."
        ),
    ]
    if any(FacetFlag.NO_GAIN in facet.flags for facet in alignment.facets):
        blocks.insert(0, Text(f"Do not turn anything: {FACET_FLAG_MEANING[FacetFlag.NO_GAIN]}.", is_warning=True))
    if alignment.facets_not_in_run:
        blocks.append(
            Text(f"Facets of the config not in this run: {', '.join(map(str, alignment.facets_not_in_run))}.")
        )
    picture = draw_psf_sum(psf_panels(result, instrument), instrument.name, result.limit)
    words = "Light of the whole reflector as measured, and as predicted after the correction; ellipses: A_sigma."
    blocks.append(Picture(compact_png(picture), words))
    return Chapter("Result", tuple(blocks))


def _done(run: RunStore, records: list[Record], origin: Origin) -> Chapter:
    accepted = sum(record.reject_reason is None for record in records)
    rows = [
        ("run", str(run.path)),
        ("recorded", f"{when_text(run.created_utc)}, by namod-ctl {run.program_version}"),
        ("records", f"{len(records)}, of which {accepted} count"),
        ("source", run.source),
    ]
    if origin.twin_words:
        rows.append(("twin", origin.twin_words))
    blocks: list[Block] = [Table((), tuple(rows), frozenset({1}))]
    if (made_of := run.note(NOTE_COMBINED)) is not None:
        blocks.append(Text("Combined from:"))
        blocks += [Text(line) for line in made_of.splitlines()]
    return Chapter("What was done", tuple(blocks))


def _commands(path: Path, run: RunStore, records: list[Record], origin: Origin, choice: str) -> tuple[str, ...]:
    name = quoted(path.resolve().name)
    commands = [
        f"namod-ctl reconstruct {name}{choice}      # from the records in run.sqlite",
        f"namod-ctl report {name}",
    ]
    if origin.seed is not None:
        accepted = sum(record.reject_reason is None for record in records)
        commands.insert(0, f"namod-ctl record --twin {origin.options} --records {accepted} --out {name}")
    elif (made_of := run.note(NOTE_COMBINED)) is not None:
        parts = " ".join(quoted(line.split(":")[0]) for line in made_of.splitlines())
        commands[0] = f"namod-ctl reconstruct {parts} --out {name}{choice}"
    return tuple(commands)
