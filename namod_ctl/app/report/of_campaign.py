"""The report of a campaign."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from namod_ctl import __version__
from namod_ctl.app.alignment_files import alignment_from_json
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_report import draw_history
from namod_ctl.app.commands.align import NOTE_WISHES
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figures import draw_psf_sum
from namod_ctl.app.pictures.psf_panels import measured_panels
from namod_ctl.app.report.document import Block, Chapter, Document, Picture, Table, Text
from namod_ctl.app.report.journal import fault_chapter, journal_chapter
from namod_ctl.app.report.motions import motion_chapters
from namod_ctl.app.report.parts import (
    area_text,
    bad_record_blocks,
    compact_png,
    config_chapter,
    doubt_arcmin,
    flag_blocks,
    map_pictures,
    number_text,
    rejection_table,
    when_text,
)
from namod_ctl.app.report.reproduce import Origin, origin_of, quoted, reproduce_chapter
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.cycle.machine import STATES
from namod_ctl.cycle.psf_check import AGREE_SIGMAS
from namod_ctl.cycle.psf_check import EVENT as PSF_CHECK
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf
from namod_ctl.reconstruction.reconstruct import Reconstruction, reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle, Event
from namod_ctl.store.folders import is_run
from namod_ctl.store.run import RunStore


def campaign_report(path: Path) -> tuple[Document, Mapping[str, bytes]]:
    """The report of the campaign at `path`, and the files that belong beside it."""
    with CampaignStore.open(path) as store:
        config = InstrumentConfig.from_json(store.config_json, f"{path}: config")
        instrument = build_instrument(config)
        origin = origin_of(store, config)
        runs = _records(store)
        measured = [cycle for cycle in store.cycles() if cycle.alignment_json is not None]
        shown = measured[:1] + measured[-1:] if len(measured) > 1 else measured
        results = _reconstructions(shown, runs, instrument)
        alignments = {cycle.number: _alignment(cycle) for cycle in measured}
        chapters = [_result(measured, results, instrument, store.events()), _done(store, origin)]
        chapters += [journal_chapter(store.events()), fault_chapter(store)]
        chapters += motion_chapters(store, instrument, alignments)
        if shown:
            chapters.append(_facets([alignments[cycle.number] for cycle in shown], [c.number for c in shown]))
        if results:
            pictures = [
                picture for number, result in results.items() for picture in map_pictures(result, _name(number))
            ]
            chapters.append(Chapter("Point spread functions and pointings", tuple(pictures)))
        chapters += [
            _rejections(runs, alignments),
            config_chapter(config, instrument),
            reproduce_chapter(origin, _commands(store, origin), __version__, store.config_json),
        ]
        name, state = store.path.name, store.last_state() or "idle"
        subtitle = f"Begun {when_text(store.created_utc)}; {store.source}. State: {state.replace('_', ' ')}. "
    return Document(
        f"{instrument.name}: campaign {name}", f"{subtitle}Reported by namod-ctl {__version__}.", tuple(chapters)
    ), origin.files


def _name(number: int) -> str:
    return f"cycle {number}"


def _records(store: CampaignStore) -> dict[int, tuple[tuple[int, ...], list[Record]]]:
    """Facet ids and records by cycle, of the cycles whose run is there."""
    found = {}
    for cycle in store.cycles():
        path = store.run_path(cycle.number)
        if is_run(path):
            with RunStore.open(path) as run:
                found[cycle.number] = (run.facet_ids, run.records())
    return found


def _reconstructions(
    cycles: Sequence[Cycle], runs: Mapping[int, tuple[tuple[int, ...], list[Record]]], instrument: Instrument
) -> dict[int, Reconstruction]:
    """Reconstructions for the pictures; a cycle whose run was taken away has none."""
    results = {}
    for cycle in cycles:
        if cycle.number in runs:
            facet_ids, records = runs[cycle.number]
            try:
                results[cycle.number] = reconstruct(tabulate_responses(records, facet_ids), instrument)
            except DataQualityError:
                continue  # it was good enough once; the numbers in the campaign's own tables stay
    return results


def _alignment(cycle: Cycle) -> Alignment:
    return alignment_from_json(cycle.alignment_json or "", _name(cycle.number))


def _result(
    measured: Sequence[Cycle],
    results: Mapping[int, Reconstruction],
    instrument: Instrument,
    events: Sequence[Event],
) -> Chapter:
    if not measured:
        return Chapter("Result", (Text("There is none yet: no cycle has been reconstructed.", is_warning=True),))
    first, last = measured[0], measured[-1]
    limit_rad2 = last.a_sigma_limit_rad2
    areas = [
        (f"before: measured in cycle {first.number}", first.a_sigma_now_rad2, first.a_sigma_uncertainty_rad2),
        (f"after: measured in cycle {last.number}", last.a_sigma_now_rad2, last.a_sigma_uncertainty_rad2),
        ("predicted if it were corrected once more", last.a_sigma_predicted_rad2, 0.0),
        ("limit: ray-traced, the same facets perfectly aligned", limit_rad2, 0.0),
    ]
    rows = tuple(
        (words, area_text(AreaOfPsf(area, doubt)), number_text(area / limit_rad2, ".2f"))
        for words, area, doubt in (areas if len(measured) > 1 else [areas[0], *areas[2:]])
    )
    head = ("cycle", "records", "A_sigma arcmin²", "predicted after it arcmin²", "what was decided")
    cycles = tuple(
        (
            str(cycle.number),
            str(cycle.n_records),
            area_text(AreaOfPsf(cycle.a_sigma_now_rad2, cycle.a_sigma_uncertainty_rad2)),
            number_text(rad2_to_arcmin2(cycle.a_sigma_predicted_rad2), ".2f"),
            cycle.decision,
        )
        for cycle in measured
    )
    blocks: list[Block] = [
        Table(("whole reflector", "A_sigma arcmin²", "times the limit"), rows),
        Table(head, cycles, frozenset({4})),
        Picture(
            compact_png(draw_history(list(measured), instrument.name, events)),
            "A_sigma of every cycle as measured and as predicted by the cycle before; broken line: ray-traced limit "
            "of mirrors without errors.",
        ),
    ]
    blocks += _psf_checks(events)
    if results:
        panels = measured_panels(list(results.values()), [f"measured in {_name(number)}" for number in results])
        picture = draw_psf_sum(panels, instrument.name, list(results.values())[-1].limit)
        blocks.append(Picture(compact_png(picture), "Light of the whole reflector as measured; ellipses: A_sigma."))
    return Chapter("Result", tuple(blocks))


def _psf_checks(events: Sequence[Event]) -> list[Block]:
    """What the PSF camera saw beside the estimates of those moments; nothing without one."""
    rows = []
    for event in events:
        if event.kind != PSF_CHECK:
            continue
        if not event.data.get("is_measured"):
            rows.append((str(event.data.get("when")), "not measured", "–", "–", event.text))
            continue
        seen, estimate = (
            area_text(AreaOfPsf(float(str(event.data[area])), float(str(event.data[doubt]))))
            if area in event.data
            else "–"
            for area, doubt in (("a_sigma_rad2", "uncertainty_rad2"), ("estimate_rad2", "estimate_uncertainty_rad2"))
        )
        apart = event.data.get("difference_sigmas")
        verdict = "nothing to compare with"
        if apart is not None:
            verdict = "they agree" if abs(float(str(apart))) <= AGREE_SIGMAS else "they do NOT agree: " + event.text
        rows.append((str(event.data["when"]), seen, estimate, str(event.data.get("cycle", "–")), verdict))
    if not rows:
        return []
    head = ("PSF camera", "A_sigma seen arcmin²", "A_sigma estimated arcmin²", "in cycle", "")
    return [Text("An independent look at the light of the whole mirror:"), Table(head, tuple(rows), frozenset({4}))]


def _done(store: CampaignStore, origin: Origin) -> Chapter:
    state = store.last_state() or "idle"
    last = store.last_transition()
    rows = [
        ("campaign", str(store.path)),
        ("begun", f"{when_text(store.created_utc)}, by namod-ctl {store.program_version}"),
        ("state", f"{state.replace('_', ' ')}: {STATES.get(state, '')}"),
        ("source", store.source),
    ]
    if last is not None:
        rows.insert(2, ("last step", f"{when_text(last.time_utc)}: {last.data.get('reason', '')}"))
    if origin.twin_words:
        rows.append(("twin", origin.twin_words))
    rows += [(f"asked for: {name}", str(wish)) for name, wish in _wishes(store).items()]
    return Chapter("What was done", (Table((), tuple(rows), frozenset({1})),))


def _wishes(store: CampaignStore) -> dict[str, object]:
    wishes: dict[str, object] = json.loads(store.note(NOTE_WISHES) or "{}")
    return wishes


def _facets(alignments: Sequence[Alignment], numbers: Sequence[int]) -> Chapter:
    """Every facet's direction in the first and the last cycle."""
    head = ["facet"]
    for number in numbers:
        head += [f"{name} in {_name(number)}" for name in ("θx", "θy", "±", "light off the aim")]
    head.append("flags in the last")
    by_id = [{facet.facet_id: facet for facet in alignment.facets} for alignment in alignments]
    rows = []
    for facet_id in by_id[-1]:
        cells = [str(facet_id)]
        for alignment, facets in zip(alignments, by_id, strict=True):
            facet = facets.get(facet_id)
            if facet is None:
                cells += ["–"] * 4
                continue
            off = rad_to_arcmin(float(np.linalg.norm(facet.theta_rad - alignment.axis_rad)))
            x, y = rad_to_arcmin(facet.theta_rad)
            cells += [number_text(x, "+.2f"), number_text(y, "+.2f"), number_text(doubt_arcmin(facet), ".2f")]
            cells.append(number_text(off, ".2f"))
        rows.append((*cells, ", ".join(by_id[-1][facet_id].flags.names)))
    blocks: list[Block] = [
        Text(
            "All in arcmin. Theta: where the star stands when the facet is brightest. Its light falls so far off the "
            "aim: twice what its normal is off by."
        )
    ]
    blocks += [Table(tuple(head), tuple(rows), frozenset({len(head) - 1}))]
    return Chapter("Facets", (*blocks, *flag_blocks(alignments[-1].facets)))


def _rejections(
    runs: Mapping[int, tuple[tuple[int, ...], list[Record]]], alignments: Mapping[int, Alignment]
) -> Chapter:
    blocks: list[Block] = [rejection_table([(_name(number), records) for number, (_, records) in runs.items()])]
    for number, alignment in alignments.items():
        if alignment.bad_records:
            blocks += [Text(f"In {_name(number)}:"), *bad_record_blocks(alignment.bad_records)]
    return Chapter("Records that do not count", tuple(blocks))


def _commands(store: CampaignStore, origin: Origin) -> tuple[str, ...]:
    wishes = {"records": max((cycle.n_records for cycle in store.cycles()), default=0)} | _wishes(store)
    options = "".join(f" --{name.replace('_', '-')} {wish}" for name, wish in wishes.items())
    name = quoted(store.path.name)
    commands = [f"namod-ctl align {origin.options}{options} --out {name}", f"namod-ctl report {name}"]
    cycles = [cycle for cycle in store.cycles() if math.isfinite(cycle.a_sigma_now_rad2)]
    if len(cycles) > 1:
        folders = [quoted(f"{store.path.name}/{cycle.run_folder}") for cycle in (cycles[0], cycles[-1])]
        commands.append(f"namod-ctl compare {' '.join(folders)}")
    return tuple(commands)
