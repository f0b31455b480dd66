"""`namod-ctl reconstruct`: point spread functions and orientations of all facets of a run."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.alignment_files import ALIGNMENT_FILE, alignment_files, alignment_to_json
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.combined_run import combined_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.figures import EXPOSURE_MAP_FILE, PSF_SUM_FILE, draw_exposure_map, draw_psf_sum
from namod_ctl.app.pictures.psf_maps import PSF_MAPS_FILE, draw_psf_maps
from namod_ctl.app.pictures.psf_panels import psf_panels
from namod_ctl.app.reconstruction_report import REPORT_FILE, halves_text, report_text
from namod_ctl.app.sheets.instructions import CSV_FILE
from namod_ctl.app.sheets.ladder_sheets import PDF_FILE
from namod_ctl.app.sheets.overlay import PNG_FILE
from namod_ctl.core.clock import Clock, SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR, ESTIMATOR_NAMES
from namod_ctl.reconstruction.halves import compare_halves
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.normalization import without_slope
from namod_ctl.reconstruction.reconstruct import Reconstruction, reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.combine import NOTE_COMBINED
from namod_ctl.store.results import write_results
from namod_ctl.store.run import RunStore

_INSTRUCTIONS = CSV_FILE, PNG_FILE, PDF_FILE
DEFAULT_BIN_SIZE_DEG = 0.01
_MIN_BIN_DEG, _MAX_BIN_DEG = 0.0005, 1.0


def reconstruct_run(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folder of the run, or of several to combine.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="COMBINED", help="Several runs: folder of the run they become.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an older combination of runs at --out.")] = False,
    estimator: Annotated[
        str, typer.Option(help=f"How a facet's centre is found: {', '.join(ESTIMATOR_NAMES)}.")
    ] = DEFAULT_ESTIMATOR,
    bin_size_deg: Annotated[
        float, typer.Option("--bin-size-deg", help="Size of the bins of the histograms.", show_default=True)
    ] = DEFAULT_BIN_SIZE_DEG,
    halves: Annotated[
        bool, typer.Option("--halves", help="Also reconstruct even and odd records separately and compare them.")
    ] = False,
    self_calibration: Annotated[
        bool,
        typer.Option(
            "--self-calibration/--no-self-calibration",
            help="Take out how responses depend on the star's brightness, where the records show it significantly.",
        ),
    ] = True,
) -> None:
    """Find the point spread function and orientation of every facet of a run.

    Writes alignment.json, facets.ecsv, report.txt and the pictures psf_maps.png, exposure_map.png and psf_sum.png
    into the run's folder. Results of an earlier reconstruction there are replaced, and instructions made from it
    are removed; run.sqlite keeps every estimate.

    Several runs of one telescope, on whatever stars and with whatever cameras, are first combined into the new run
    COMBINED, which is then like any other; the runs themselves stay as they are. Where the cameras' scales differ
    significantly between runs, the facets' light shows by which factor, and it is divided out.

    Example: namod-ctl reconstruct runs/2014-05

    Example: namod-ctl reconstruct NIGHT1 NIGHT2 --out BOTH
    """
    if not _MIN_BIN_DEG <= bin_size_deg <= _MAX_BIN_DEG:
        raise ConfigError(
            f"--bin-size-deg {bin_size_deg:g}: must lie between {_MIN_BIN_DEG:g} and {_MAX_BIN_DEG:g} deg"
        )
    if estimator not in ESTIMATOR_NAMES:
        raise ConfigError(f"--estimator {estimator}: choose one of {', '.join(ESTIMATOR_NAMES)}")
    if len(runs) > 1 and out is None:
        raise ConfigError(f"{len(runs)} runs are named: say with --out where the run goes that combines them")
    if len(runs) == 1 and (out is not None or force):
        raise ConfigError("--out and --force are for several runs: the results of one run go into its own folder")
    for named in runs:
        check_run(named)
    console = Console(highlight=False)
    clock = SystemClock()
    with ExitStack() as stack:
        run = folder = runs[0]
        if out is not None:
            run = out
            with console.status(f"combining {len(runs)} runs"):
                folder = stack.enter_context(combined_run(runs, out, clock, force=force))
        had_instructions = any((run / name).exists() for name in _INSTRUCTIONS)
        report = reconstruct_in(
            folder,
            estimator,
            deg_to_rad(bin_size_deg),
            clock,
            console,
            halves=halves,
            self_calibration=self_calibration,
        )
    console.print(report, soft_wrap=True, markup=False)
    console.print(
        f"Written to {run}: {ALIGNMENT_FILE}, {REPORT_FILE}, tables and pictures. Next: namod-ctl instruct {run}",
        soft_wrap=True,
        markup=False,
    )
    if had_instructions:
        console.print(
            "The instructions.* that lay there were of an older reconstruction and are removed: make new ones before "
            f"anybody turns a bolt, and keep no old sheet: namod-ctl instruct {run}",
            soft_wrap=True,
            markup=False,
        )


def reconstruct_in(
    run: Path,
    estimator: str,
    bin_size_rad: float,
    clock: Clock,
    console: Console,
    *,
    halves: bool,
    self_calibration: bool = True,
) -> str:
    """The report of the run's reconstruction; it and all other results are in the run's folder then."""
    with RunStore.open(run, read_only=False) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{run}: config"))
        records = store.records()
        table = tabulate_responses(records, store.facet_ids)
        n_rejected = Counter(record.reject_reason for record in records if record.reject_reason is not None)
        with console.status(f"fitting {len(table.facet_ids)} facets to {table.n_records} records"):
            result = reconstruct(table, instrument, estimator, bin_size_rad, self_calibration=self_calibration)
            comparison = None
            if halves:  # of the same responses: one half alone may not show what all records do
                calibrated = without_slope(table, result.removed_exponent)
                comparison = compare_halves(calibrated, instrument, estimator, bin_size_rad)
        report = report_text(result, n_rejected)
        made_of = store.note(NOTE_COMBINED)
        if made_of is not None:
            bad = {record.index for record in result.alignment.bad_records}
            report += _combination_text(made_of, [label for index, label in store.labels() if index in bad])
        if comparison is not None:
            report += halves_text(comparison)
        with console.status("drawing"):
            _write(run, result, instrument, bin_size_rad, report)
        store.save_estimate(estimator, alignment_to_json(result.alignment), clock)
    return report


def _combination_text(made_of: str, bad_labels: list[str]) -> str:
    """Which runs a combined run is made of and which of their records are bad, as plain text."""
    lines = ["", "Combined from", *(f"  {line}" for line in made_of.splitlines())]
    if bad_labels:
        lines += ["", "Bad records, in the runs they come from", *(f"  {label}" for label in bad_labels)]
    return "\n".join(lines) + "\n"


def _write(run: Path, result: Reconstruction, instrument: Instrument, bin_size_rad: float, report: str) -> None:
    pictures = {
        PSF_MAPS_FILE: draw_psf_maps(histogram_responses(result.used, bin_size_rad), result.used, result.alignment),
        EXPOSURE_MAP_FILE: draw_exposure_map(
            histogram_responses(result.table, bin_size_rad), result.table, result.alignment
        ),
        PSF_SUM_FILE: draw_psf_sum(psf_panels(result, instrument), instrument.name, result.limit),
    }
    files = {name: figure_to_png(figure) for name, figure in pictures.items()}
    write_results(run, files | {REPORT_FILE: report.encode()} | alignment_files(result.alignment))
    for name in _INSTRUCTIONS:
        (run / name).unlink(missing_ok=True)  # instructions of another estimate must not be taken for this one's
