"""`namod-ctl instruct`: what the people at the telescope shall turn, as a list, a picture and sheets."""

from __future__ import annotations

from collections import Counter
from datetime import date
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from namod_ctl.app.alignment_files import read_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.sheets.instructions import (
    CSV_FILE,
    FacetInstruction,
    Verdict,
    facet_instructions,
    instructions_to_csv,
)
from namod_ctl.app.sheets.ladder_sheets import PDF_FILE, sheets_to_pdf
from namod_ctl.app.sheets.overlay import PNG_FILE, draw_instructions
from namod_ctl.app.views.number_ranges import counted
from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.frames import REFLECTOR_CAMERA
from namod_ctl.store.results import write_results
from namod_ctl.store.run import RunStore

Image = NDArray[np.uint8]

_MOST_FRAMES = 30  # of a run are laid over each other; more show nothing new


def instruct(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run that was reconstructed.")],
    image: Annotated[
        Path | None,
        typer.Option(help="Picture of the reflector, the camera's whole frame at any size. Default: the run's frames."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the files. Default: the run's own folder.")] = None,
) -> None:
    """Write instructions.csv, instructions.png and instructions.pdf for the people who turn the bolts.

    Facets without a trustworthy estimate are marked "do not turn" and carry no numbers. Picture and sheets show turns
    as the goniometer of the config can set them; the CSV holds whole degrees.

    Example: namod-ctl instruct runs/2014-05 --image reflector.png
    """
    check_run(run)
    with RunStore.open(run) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{run}: config"))
        alignment = read_alignment(run)
        _refuse_foreign_alignment(alignment, instrument, store.facet_ids, run)
        picture = (
            read_picture(image)
            if image is not None
            else _picture_of_run(store, instrument.reflector_camera.full_scale_adu)
        )
    folder = out if out is not None else run
    if not folder.is_dir():
        raise ConfigError(f"{folder}: this folder does not exist; make it, or leave --out out to write into {run}")
    try:
        instructions = write_instructions(folder, alignment, instrument, picture, run.resolve().name)
    except ConfigError as error:
        raise ConfigError(f"{image if image is not None else run}: {error}") from None
    _report(alignment, instructions, folder)


def write_instructions(
    folder: Path, alignment: Alignment, instrument: Instrument, picture: Image | None, name: str
) -> tuple[FacetInstruction, ...]:
    """Write the three files into `folder`; `name` of the run stands in their headlines. Returns what they ask for."""
    instructions = facet_instructions(alignment, instrument.goniometer_resolution_rad)
    headline = _headline(alignment, name, instructions)
    n_bolts = max((len(facet.bolt_turn_deg) for facet in alignment.facets), default=0)
    files = {
        CSV_FILE: instructions_to_csv(instructions, n_bolts).encode(),
        PNG_FILE: figure_to_png(draw_instructions(instrument, instructions, picture, headline)),
        PDF_FILE: sheets_to_pdf(instrument, instructions, headline, date.today()),
    }
    write_results(folder, files)
    return instructions


def read_picture(path: Path) -> Image:
    """A picture file as RGB, shape (rows, columns, 3). Raises ConfigError when it is not one."""
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); give the picture of the reflector") from None
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if decoded is None:
        raise ConfigError(f"{path}: is no picture that can be read; give a PNG, JPEG or TIFF file")
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _picture_of_run(store: RunStore, full_scale_adu: float) -> Image | None:
    """The run's reflector frames over each other, so that every facet appears lit; None when none were kept."""
    labels = store.labels()
    picture: Image | None = None
    for index, _ in labels[:: max(1, len(labels) // _MOST_FRAMES)]:
        try:
            kept = store.frame(index, REFLECTOR_CAMERA)
        except StoreError:
            continue  # not kept, or damaged: another frame serves as well
        scale = 255.0 / full_scale_adu if kept.dtype == np.uint16 else 1.0
        frame: Image = np.asarray(cv2.convertScaleAbs(kept, alpha=scale), dtype=np.uint8)
        if frame.ndim == 2:
            frame = np.repeat(frame[:, :, np.newaxis], 3, axis=2)
        if picture is None:
            picture = frame
        elif frame.shape == picture.shape:
            picture = np.maximum(picture, frame)
    return None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _refuse_foreign_alignment(
    alignment: Alignment, instrument: Instrument, facet_ids: tuple[int, ...], run: Path
) -> None:
    """Raise ConfigError when the alignment is not this run's: other facets, facets twice, another telescope."""
    found = [facet.facet_id for facet in alignment.facets]
    if sorted(found) == sorted(facet_ids) and alignment.telescope == instrument.name:
        return
    odd = sorted(set(found) ^ set(facet_ids)) or "given twice"
    raise ConfigError(
        f"{run}: alignment.json (of {alignment.telescope}) does not belong to this run of {instrument.name}: facets "
        f"{odd}; run `namod-ctl reconstruct {run}` anew"
    )


def _counts(instructions: tuple[FacetInstruction, ...]) -> str:
    numbers = Counter(instruction.verdict for instruction in instructions)
    words = {
        Verdict.TURN: "to turn",
        Verdict.NO_TURN_NEEDED: "need no turn",
        Verdict.DO_NOT_TURN: "not to be turned",
        Verdict.NO_BOLTS: "without bolts",
    }
    return ", ".join(f"{numbers[verdict]} {text}" for verdict, text in words.items() if numbers[verdict])


def _forbidden(instructions: tuple[FacetInstruction, ...]) -> dict[str, list[int]]:
    """Facets that nobody should turn, by what stands against it; what is said of one facet alone comes after that."""
    groups: dict[str, list[int]] = {}
    for instruction in instructions:
        if instruction.verdict is Verdict.DO_NOT_TURN:
            repeated = f"facet {instruction.facet_id}: do not turn: "
            reasons = dict.fromkeys(reason.removeprefix(repeated) for reason in instruction.reasons)
            groups.setdefault("; ".join(reasons) or "no reliable estimate", []).append(instruction.facet_id)
    return groups


def _headline(alignment: Alignment, run: str, instructions: tuple[FacetInstruction, ...]) -> str:
    headline = (
        f"{alignment.telescope}, run {run}: {counted(len(instructions), 'facet')}, {_counts(instructions)} "
        f"(estimator {alignment.estimator}, {alignment.n_used} of {alignment.n_records} records)"
    )
    doubtful = _resting_on_bad_records(alignment)
    return f"{headline}. WRONG, rests on a bad record: {doubtful}" if doubtful else headline


def _resting_on_bad_records(alignment: Alignment) -> str:
    """Ids of the facets whose turns rest on a bad record, for people."""
    flagged = (facet.facet_id for facet in alignment.facets if facet.flags & FacetFlag.RESTS_ON_BAD_RECORD)
    return ", ".join(map(str, flagged))


def _report(alignment: Alignment, instructions: tuple[FacetInstruction, ...], folder: Path) -> None:
    typer.echo(f"{counted(len(instructions), 'facet')}: {_counts(instructions)}.")
    if instructions and all(instruction.verdict is Verdict.NO_BOLTS for instruction in instructions):
        typer.echo("This telescope has no bolts: its legs are driven; their travels are in alignment.json.")
    for reasons, facet_ids in _forbidden(instructions).items():
        ids = ", ".join(map(str, facet_ids))
        typer.echo(f"Do not turn facet{'s' if len(facet_ids) > 1 else ''} {ids}: {reasons}.")
    if doubtful := _resting_on_bad_records(alignment):
        typer.echo(
            f"Estimator {alignment.estimator} does not leave out bad records: the turns of facets {doubtful} rest "
            "on one. Turn by the default estimator instead: namod-ctl reconstruct without --estimator."
        )
    if alignment.facets_not_in_run:
        ids = ", ".join(map(str, alignment.facets_not_in_run))
        typer.echo(f"Not in this run, so without an instruction: facet ids {ids}.")
    typer.echo(f"Written to {folder}: {CSV_FILE}, {PNG_FILE}, {PDF_FILE}.")
