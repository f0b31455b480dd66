"""`namod-ctl lut`: how gravity turns the facets, and what is done about it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from namod_ctl.app.build.gravity_runs import read_gravity_runs
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import load_twin_settings
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.lazy_commands import MARKUP
from namod_ctl.app.lut.application import apply_table
from namod_ctl.app.lut.files import lut_of_fit, lut_to_json, read_lut
from namod_ctl.app.lut.wishes import side_of_words, sides_of_words, stars_of_words, weights_of_words, zeniths_of_words
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.lut_figure import draw_lut
from namod_ctl.app.sheets.bias_sheets import AIMS_FILE, bias_files
from namod_ctl.app.sheets.ladder_sheets import PDF_FILE
from namod_ctl.app.views.lut_tables import (
    areas_table,
    facets_table,
    fit_in_words,
    runs_table,
    terms_in_words,
    tilts_table,
)
from namod_ctl.calibration.gravity.bias_alignment import Aim, best_compromise
from namod_ctl.calibration.gravity.gravity_table import BEYOND_RAD, GravityTable, zenith_grid_rad
from namod_ctl.calibration.gravity.sag_of_runs import fit_sag
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.store.frames import write_file_durably
from namod_ctl.store.results import write_results
from namod_ctl.twin.settings import TwinSettings

Array = NDArray[np.float64]

PICTURE_FILE = "lut.png"
BIAS_PICTURE_FILE = "bias.png"
DEFAULT_CONFIG = "fact_actuated"
DEFAULT_BIAS_CONFIG = "fact"
DEFAULT_SEED = 1
STEP_DEG = 5.0

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=MARKUP,
    help="Gravity: look-up tables of corrections over zenith distance.",
    epilog="Example: namod-ctl lut fit RUN10 RUN25 RUN40 RUN60 --out LUT.json",
)

_LutFile = Annotated[Path, typer.Argument(metavar="LUT", help="File that 'namod-ctl lut fit' wrote.")]
_AlignedAt = Annotated[
    float | None,
    typer.Option("--aligned-at-deg", metavar="DEG", help="Zenith distance at which the facets were aligned."),
]


@app.command()
def fit(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Reconstructed runs between which nothing was turned.")
    ],
    out: Annotated[Path, typer.Option("--out", help="File to write, such as LUT.json.")],
    zenith_deg: Annotated[
        str | None,
        typer.Option(help="Zenith distances of the runs, in their order: 10,25,40,60.  [default: what the runs know]"),
    ] = None,
    star: Annotated[
        str | None,
        typer.Option(
            help="Star that the runs were recorded on, or one for each: Vega,Deneb,Vega. With [site] in the config and "
            "the records' times it gives the zenith distances."
        ),
    ] = None,
    came_from: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="From where the telescope came to each run: above (from the zenith), below or unknown, such as "
            "above,below,above,below.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
) -> None:
    """Find how gravity turns every facet, from runs at several zenith distances.

    At least 3 runs are needed, 4 from 10 to 60 deg are good; some to which the telescope came from above and some from
    below show its hysteresis as well. Runs of the twin know their zenith distance. What the whole image does is told
    apart from what facets do relative to each other, which alone spreads light.

    Example: namod-ctl lut fit RUN10 RUN25 RUN40 RUN60 --zenith-deg 10,25,40,60 --out LUT.json
    """
    _check_output(out, force=force)
    zeniths = None if zenith_deg is None else zeniths_of_words(zenith_deg, len(runs))
    if zenith_deg is not None and star is not None:
        raise ConfigError("--zenith-deg and --star both tell where the telescope stood; leave one out")
    stars = None if star is None else stars_of_words(star, len(runs))
    sides = None if came_from is None else sides_of_words(came_from, len(runs))
    read = read_gravity_runs(runs, zeniths, stars, sides)
    console = _console()
    with console.status(f"fitting {len(read.facet_ids)} facets to {len(runs)} runs"):
        found = fit_sag(read.runs, read.light)
    lut = lut_of_fit(
        found, read.instrument.name, read.facet_ids, read.runs, read.light, read.variance_rad2, SystemClock(),
        read.remarks,
    )  # fmt: skip
    write_file_durably(out, lut_to_json(lut).encode())
    console.print(runs_table(lut))
    for line in fit_in_words(lut):
        console.print(line, markup=False)
    console.print(f"Written to {out}. Next: namod-ctl lut show {out}", markup=False)


@app.command()
def show(
    lut: _LutFile,
    zenith_deg: Annotated[
        float | None, typer.Option("--zenith-deg", metavar="DEG", help="Also list the changes to this zenith distance.")
    ] = None,
    aligned_at_deg: _AlignedAt = None,
    out: Annotated[
        Path | None, typer.Option("--out", help=f"Folder for {PICTURE_FILE}.  [default: that of the table]")
    ] = None,
) -> None:
    """Show a look-up table: its facets, and A_sigma over zenith distance without and with it.

    Example: namod-ctl lut show LUT.json --zenith-deg 40
    """
    read = read_lut(lut)
    table = read.table
    aligned_rad = _aligned_at(table, aligned_at_deg)
    folder = _folder(out, lut)
    zenith_rad = _grid(table)
    without = table.areas_without_rad2(zenith_rad, aligned_rad)
    with_table, uncertainty = table.areas_with(zenith_rad, aligned_rad)
    at = f"aligned at {rad_to_deg(aligned_rad):.0f} deg"
    curves = [(f"{at}, then left alone", without), ("with the table", with_table)]
    console = _console()
    console.print(runs_table(read))
    console.print(facets_table(read))
    for line in fit_in_words(read):
        console.print(line, markup=False)
    if zenith_deg is not None:
        table.check_zenith(deg_to_rad(zenith_deg), "--zenith-deg")
        console.print(tilts_table(read, aligned_rad, deg_to_rad(zenith_deg)))
    console.print(areas_table(zenith_rad, curves, table.limit_rad2(), uncertainty))
    title = f"{table.telescope}: look-up table of {read.made_utc[:10]}, {terms_in_words(table.terms)}"
    write_results(folder, {PICTURE_FILE: figure_to_png(draw_lut(read, zenith_rad, curves, title, uncertainty))})
    console.print(
        f"Drawn: {folder / PICTURE_FILE}. Next: facets with motors: namod-ctl lut apply {lut} --zenith-deg 40 "
        f"--aligned-at-deg {rad_to_deg(aligned_rad):.0f}; with bolts: namod-ctl lut bias {lut}",
        markup=False,
    )


@app.command()
def apply(
    lut: _LutFile,
    zenith_deg: Annotated[float, typer.Option("--zenith-deg", metavar="DEG", help="Where the telescope goes.")],
    config: Annotated[
        str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")
    ] = DEFAULT_CONFIG,
    aligned_at_deg: Annotated[
        float | None,
        typer.Option(
            "--aligned-at-deg",
            metavar="DEG",
            help="Needed once after every alignment: the facets stand now as aligned at this zenith distance.",
        ),
    ] = None,
    came_from: Annotated[
        str | None, typer.Option("--from", help="From where the telescope comes: above or below, if hysteresis counts.")
    ] = None,
    journal: Annotated[
        Path | None,
        typer.Option(
            "--journal", help="Folder in which all moves are on record.  [default: beside the table, named like it]"
        ),
    ] = None,
    twin: Annotated[
        bool, typer.Option("--twin", help="Rehearse on the digital twin; its world is kept in the journal.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help=f"Of a new twin.  [{DEFAULT_SEED}]")] = None,
    twin_settings: Annotated[
        Path | None, typer.Option("--twin-settings", metavar="FILE", help="Of a new twin, a TOML file.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before anything moves.")] = False,
) -> None:
    """Turn the facets by motors from the zenith distance of their alignment to another, as the table says.

    What will move is shown and asked first. Legs go to absolute places reckoned from the alignment, so applying a
    table twice moves nothing. Ctrl-C, and 'namod-ctl stop JOURNAL' from another terminal, stop all drives.

    Example: namod-ctl lut apply LUT.json --zenith-deg 40 --aligned-at-deg 25 --twin
    """
    read = read_lut(lut)
    read.table.check_zenith(deg_to_rad(zenith_deg), "--zenith-deg")
    if aligned_at_deg is not None:
        read.table.check_zenith(deg_to_rad(aligned_at_deg), "--aligned-at-deg")
    loaded = load_config(config)
    if loaded.actuators is None:
        raise ConfigError(
            f"{config}: this telescope has no motors that could follow a table. Let people turn its bolts once to the "
            f"best compromise over all zenith distances: namod-ctl lut bias {lut} --from-deg 5 --to-deg 65"
        )
    _refuse_other_telescope(lut, read.table, loaded)
    if not twin and (seed is not None or twin_settings is not None):
        raise ConfigError("--seed and --twin-settings are the twin's; add --twin")
    settings = TwinSettings() if twin_settings is None else load_twin_settings(twin_settings)
    is_complete = apply_table(
        read.table,
        loaded,
        deg_to_rad(zenith_deg),
        None if aligned_at_deg is None else deg_to_rad(aligned_at_deg),
        None if came_from is None else side_of_words(came_from),
        journal or lut.with_name(f"{lut.stem}_moves"),
        (settings, DEFAULT_SEED if seed is None else seed) if twin else None,
        _console(),
        is_yes=yes,
    )
    if not is_complete:
        raise typer.Exit(1)


@app.command()
def bias(
    lut: _LutFile,
    from_deg: Annotated[float, typer.Option("--from-deg", help="Least zenith distance to be observed at.")] = 5.0,
    to_deg: Annotated[float, typer.Option("--to-deg", help="Largest zenith distance to be observed at.")] = 65.0,
    aim: Annotated[Aim, typer.Option(help="What is to be small: A_sigma's mean over the range, or the worst.")] = (
        Aim.MEAN
    ),
    weights: Annotated[
        str | None,
        typer.Option(
            help="Observing time at zenith distances, such as 5:1,20:3,65:1, straight in between.  [default: even]"
        ),
    ] = None,
    aligned_at_deg: Annotated[
        float | None,
        typer.Option(
            "--aligned-at-deg",
            metavar="DEG",
            help="The facets were aligned at this zenith distance since.  [default: they stand as the runs found them]",
        ),
    ] = None,
    config: Annotated[
        str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")
    ] = DEFAULT_BIAS_CONFIG,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files.")] = Path(),
) -> None:
    """Find the best orientations of facets that cannot follow, and write sheets for the people who turn the bolts.

    Bias alignment: every facet is turned to a compromise that keeps the image small over a range of zenith distances.

    Example: namod-ctl lut bias LUT.json --from-deg 5 --to-deg 65
    """
    read = read_lut(lut)
    table = read.table
    for option, angle_deg in (("--from-deg", from_deg), ("--to-deg", to_deg)):
        table.check_zenith(deg_to_rad(angle_deg), option)
    if not from_deg < to_deg:
        raise ConfigError(f"--from-deg {from_deg:g} --to-deg {to_deg:g}: the first must be the smaller")
    aligned_rad = None
    if aligned_at_deg is not None:
        aligned_rad = deg_to_rad(aligned_at_deg)
        table.check_zenith(aligned_rad, "--aligned-at-deg")
    loaded = load_config(config)
    _refuse_other_telescope(lut, table, loaded)
    if not out.is_dir():
        raise ConfigError(f"{out}: this folder does not exist; make it, or leave --out out to write into this one")
    zenith_rad = zenith_grid_rad(deg_to_rad(from_deg), deg_to_rad(to_deg), deg_to_rad(STEP_DEG / 2.0))
    share = np.ones(len(zenith_rad)) if weights is None else weights_of_words(weights, rad_to_deg(zenith_rad))
    best = best_compromise(table, zenith_rad, share, aim)
    at_rad = float(zenith_rad[len(zenith_rad) // 2]) if aligned_rad is None else aligned_rad
    alone = f"aligned at {rad_to_deg(at_rad):g} deg", table.areas_without_rad2(zenith_rad, at_rad)
    biased = f"bias alignment, least {aim.value}", best.area_rad2
    headline = f"{table.telescope}: bias alignment for {from_deg:g} to {to_deg:g} deg from zenith, least {aim.value}"
    files, summary, has_turns = bias_files(table, best, aligned_rad, build_instrument(loaded), headline)
    files[BIAS_PICTURE_FILE] = figure_to_png(draw_lut(read, zenith_rad, [alone, biased], headline))
    write_results(out, files)
    curves = [alone, biased]
    if aligned_rad is None:
        found = table.area_rad2(table.motion_rad(zenith_rad) + np.nan_to_num(table.beta_rad[:, 0]))
        curves = [("as the runs found it", found), *curves]
    console, limit = _console(), table.limit_rad2()
    console.print(areas_table(zenith_rad[::2], [(name, area[::2]) for name, area in curves], limit))
    for name, area in curves:
        mean, worst = float(share @ area / share.sum()) / limit, float(area.max()) / limit
        console.print(f"A_sigma {name}: mean {mean:.3f}, worst {worst:.3f} times the limit", markup=False)
    console.print(summary, markup=False)
    next_words = (
        f"print {PDF_FILE} and turn, then record a run and compare it with {AIMS_FILE}"
        if has_turns
        else "leave the bolts as they are: all turns are smaller than people can make"
    )
    console.print(f"Written to {out}: {', '.join(files)}. Next: {next_words}.", markup=False)


def _console() -> Console:
    return Console(highlight=False, soft_wrap=True)


def _grid(table: GravityTable) -> Array:
    """Zenith distances at which a table says something, in steps of 5 deg."""
    low, high = table.zenith_range_rad
    from_deg = STEP_DEG * np.ceil(max(rad_to_deg(low - BEYOND_RAD), 0.0) / STEP_DEG - 1e-6)
    to_deg = STEP_DEG * np.floor(min(rad_to_deg(high + BEYOND_RAD), 90.0) / STEP_DEG + 1e-6)
    return zenith_grid_rad(deg_to_rad(float(from_deg)), deg_to_rad(float(to_deg)), deg_to_rad(STEP_DEG))


def _aligned_at(table: GravityTable, aligned_at_deg: float | None) -> float:
    """What was given, or the middle of the runs."""
    if aligned_at_deg is None:
        return sum(table.zenith_range_rad) / 2.0
    table.check_zenith(deg_to_rad(aligned_at_deg), "--aligned-at-deg")
    return deg_to_rad(aligned_at_deg)


def _refuse_other_telescope(path: Path, table: GravityTable, config: InstrumentConfig) -> None:
    ids = {facet.id for facet in config.facets}
    strange = sorted(ids ^ set(table.facet_ids))
    if config.telescope.name != table.telescope:
        problem = f"is a table of {table.telescope}, the config is of {config.telescope.name}"
    elif strange:
        listed = ", ".join(map(str, strange[:5])) + (", ..." if len(strange) > 5 else "")
        problem = f"has other facets than the config of {config.telescope.name}: {listed}"
    else:
        return
    raise ConfigError(f"{path}: {problem}; name the config of the telescope that was recorded with --config")


def _check_output(out: Path, *, force: bool) -> None:
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; --out takes the name of a file, such as LUT.json")
    if out.exists() and not force:
        raise ConfigError(f"{out}: the file exists; choose another name, or replace it with --force")
    if not out.resolve().parent.is_dir():
        raise ConfigError(f"{out.resolve().parent}: this folder does not exist; make it first")


def _folder(out: Path | None, lut: Path) -> Path:
    folder = lut.resolve().parent if out is None else out
    if not folder.is_dir():
        raise ConfigError(f"{folder}: this folder does not exist; make it, or leave --out out")
    return folder
