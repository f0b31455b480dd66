"""`namod-ctl reconstruct`: point spread functions and orientations of all facets of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from namod_ctl.app.alignment_files import ALIGNMENT_FILE, alignment_to_json, write_alignment
from namod_ctl.app.build import build_instrument
from namod_ctl.app.config import InstrumentConfig
from namod_ctl.app.figure_style import figure_to_png
from namod_ctl.app.figures import EXPOSURE_MAP_FILE, PSF_SUM_FILE, draw_exposure_map, draw_psf_sum
from namod_ctl.app.psf_maps import PSF_MAPS_FILE, draw_psf_maps
from namod_ctl.app.psf_panels import psf_panels
from namod_ctl.app.reconstruction_report import REPORT_FILE, report_text
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_arcmin
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR, ESTIMATOR_NAMES
from namod_ctl.reconstruction.halves import HalvesComparison, compare_halves
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.reconstruct import Reconstruction, reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.frames import write_file_durably
from namod_ctl.store.run import RunStore

_MIN_BIN_DEG, _MAX_BIN_DEG = 0.0005, 1.0


def reconstruct_run(
    run: Annotated[Path, typer.Argument(help="Folder of the run.")],
    estimator: Annotated[
        str, typer.Option(help=f"How a facet's centre is found: {', '.join(ESTIMATOR_NAMES)}.")
    ] = DEFAULT_ESTIMATOR,
    bin_size_deg: Annotated[
        float, typer.Option("--bin-size-deg", help="Size of the bins of the histograms.", show_default=True)
    ] = 0.01,
    halves: Annotated[
        bool, typer.Option("--halves", help="Also reconstruct even and odd records separately and compare them.")
    ] = False,
) -> None:
    """Find the point spread function and orientation of every facet of a run.

    Writes alignment.json, facets.ecsv, report.txt and the pictures psf_maps.png, exposure_map.png and psf_sum.png
    into the run's folder. Results of an earlier reconstruction there are replaced; the run keeps every one of them.

    Example: namod-ctl reconstruct runs/2014-05
    """
    if not _MIN_BIN_DEG <= bin_size_deg <= _MAX_BIN_DEG:
        raise ConfigError(
            f"--bin-size-deg {bin_size_deg:g}: must lie between {_MIN_BIN_DEG:g} and {_MAX_BIN_DEG:g} deg"
        )
    if estimator not in ESTIMATOR_NAMES:
        raise ConfigError(f"--estimator {estimator}: choose one of {', '.join(ESTIMATOR_NAMES)}")
    bin_size_rad = deg_to_rad(bin_size_deg)
    console = Console(highlight=False)
    with RunStore.open(run, read_only=False) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{run}: config"))
        table = tabulate_responses(store.records(), store.facet_ids)
        with console.status(f"fitting {len(table.facet_ids)} facets to {table.n_records} records"):
            result = reconstruct(table, instrument, estimator, bin_size_rad)
            comparison = compare_halves(table, instrument, estimator, bin_size_rad) if halves else None
        with console.status("drawing"):
            _write(run, result, instrument, bin_size_rad)
        store.save_estimate(estimator, alignment_to_json(result.alignment), SystemClock())
    text = report_text(result)
    console.print(text, soft_wrap=True, markup=False)
    if comparison is not None:
        _print_halves(console, comparison)
    console.print(
        f"Written to {run}: {ALIGNMENT_FILE}, {REPORT_FILE}, tables and pictures. Next: namod-ctl instruct {run}",
        soft_wrap=True,
    )


def _write(run: Path, result: Reconstruction, instrument: Instrument, bin_size_rad: float) -> None:
    pictures = {
        PSF_MAPS_FILE: draw_psf_maps(histogram_responses(result.used, bin_size_rad), result.used, result.alignment),
        EXPOSURE_MAP_FILE: draw_exposure_map(
            histogram_responses(result.table, bin_size_rad), result.table, result.alignment
        ),
        PSF_SUM_FILE: draw_psf_sum(psf_panels(result, instrument), instrument.name, result.limit),
    }
    for name, figure in pictures.items():
        write_file_durably(run / name, figure_to_png(figure))
    write_file_durably(run / REPORT_FILE, report_text(result).encode())
    write_alignment(run, result.alignment)


def _print_halves(console: Console, comparison: HalvesComparison) -> None:
    distance = rad_to_arcmin(comparison.distance_rad)
    sound = np.isfinite(distance) & ~comparison.is_flagged
    grid = Table(title="Even against odd records", title_justify="left")
    for heading in ("facets", "number", "median / arcmin", "rms / arcmin", "width of pulls"):
        grid.add_column(heading, justify="right" if heading != "facets" else "left")
    for name, chosen in (("all with an estimate", np.isfinite(distance)), ("not flagged", sound)):
        if not chosen.any():
            continue
        pull = comparison.pull[chosen]
        grid.add_row(
            name,
            str(int(chosen.sum())),
            f"{np.median(distance[chosen]):.2f}",
            f"{np.sqrt(np.mean(distance[chosen] ** 2)):.2f}",
            f"{np.std(pull):.2f}" if np.isfinite(pull).all() else "-",
        )
    console.print(grid)
    flagged = [str(facet) for facet, flag in zip(comparison.facet_ids, comparison.is_flagged, strict=True) if flag]
    console.print(f"Flagged in either half: {', '.join(flagged) or 'none'}")
