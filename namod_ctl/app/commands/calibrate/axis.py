"""`namod-ctl calibrate axis`: where the telescope's optical axis lies in the star camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from namod_ctl.app.build.axis_source import TWIN_ZENITH_DEG, held_position, rehearse_held, run_position
from namod_ctl.app.build.frame_series import twin_of_runs
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.config.calibration_schema import AxisCalibration
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.pictures.axis_picture import draw_axis
from namod_ctl.app.pictures.figure_style import figure_to_png, picture_beside
from namod_ctl.calibration.geometry.optical_axis import AxisFit, AxisPosition, combine_axis
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_arcmin, rad_to_deg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.frames import write_file_durably

GOOD_ARCMIN = 1.0
"""Uncertainty up to which corrections that aim at the axis are better than those at the common centre."""
DEFAULT_SEED = 1


def axis(
    run: Annotated[
        list[Path] | None,
        typer.Option("--run", metavar="RUN", help="From the facets' common centre in this run; may be repeated."),
    ] = None,
    held: Annotated[
        list[Path] | None,
        typer.Option(
            "--held",
            metavar="FRAMES",
            help="From star frames (a file, folder or run) taken while the star was held on the PSF camera's centre; "
            "may be repeated.",
        ),
    ] = None,
    zenith_deg: Annotated[
        list[float] | None,
        typer.Option("--zenith-deg", help="Zenith distance of each --run or --held, in their order."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the calibration, and a .png.")
    ] = None,
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse it with stars that a digital twin holds.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the twin.")] = DEFAULT_SEED,
    valid_days: Annotated[float, typer.Option(help="How long the calibration holds.")] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace an older file.")] = False,
) -> None:
    """Find where the telescope's optical axis lies in the star camera, and whether it moves with the zenith distance.

    Corrections then aim at this axis, not at the facets' common centre: the image of an aligned mirror stands in the
    middle of the focal plane. --run tells where the light goes now; --held is told by the focal plane itself, and is
    the better one for a mirror that is badly out of alignment.

    Example: namod-ctl calibrate axis --held LOW --zenith-deg 60 --held HIGH --zenith-deg 20 --out axis.json
    """
    runs, series = list(run or []), list(held or [])
    _check_choice(runs, series, is_twin=twin)
    if out is not None:
        check_calibration_output(out, force=force)
        check_calibration_output(picture_beside(out), force=force)
    loaded = load_config(config)
    instrument = build_instrument(loaded)
    camera = instrument.star_camera
    console = Console(soft_wrap=True, highlight=False, markup=False)
    sources: Sequence[Path] = runs or series
    method: Literal["common centre of the facets", "held star"] = "common centre of the facets" if runs else "held star"
    positions: list[AxisPosition] = []
    twin_seed = seed if twin else twin_of_runs(sources)
    if twin:
        console.print("Rehearsal: these are stars of a digital twin, not of your telescope.", style="bold")
        with console.status("the twin holds its star"):
            positions = rehearse_held(instrument, seed)
        names = [f"twin at {angle:.0f} deg" for angle in TWIN_ZENITH_DEG]
    else:
        zeniths = _zeniths(zenith_deg or [], len(sources))
        names = [path.name or str(path) for path in sources]
        for path, angle in zip(sources, zeniths, strict=True):
            with console.status(f"measuring {path}"):
                positions.append(
                    run_position(path, camera, angle)
                    if runs
                    else held_position(path, camera, instrument.star_size_rad, angle, console.print)
                )
    fit = combine_axis(positions)
    _print_positions(console, names, positions)
    remarks, is_good = _remarks(fit, positions, camera, is_run=bool(runs))
    x_px, y_px = (float(value) for value in fit.pixel)
    (c_xx, c_xy), (_, c_yy) = fit.covariance_px2
    calibration = AxisCalibration(
        **new_header(
            loaded.star_camera,
            "star_camera",
            SystemClock(),
            source=f"{method}: {', '.join(names)}" + ("" if twin_seed is None else f"; digital twin, seed {twin_seed}"),
            verdict="good" if is_good else "limited",
            remarks=tuple(remarks),
            valid_days=valid_days,
            twin_seed=twin_seed,
        ),
        kind="axis",
        axis_px=(x_px, y_px),
        covariance_px2=((float(c_xx), float(c_xy)), (float(c_xy), float(c_yy))),
        method=method,
        over_zenith=tuple(
            (rad_to_deg(position.zenith_rad), float(position.pixel[0]), float(position.pixel[1]))
            for position in positions
            if position.zenith_rad is not None
        ),
    )
    sigma = np.sqrt(np.diag(fit.covariance_px2))
    console.print(f"  {'optical axis':16s} column {x_px:.2f} +- {sigma[0]:.2f}, row {y_px:.2f} +- {sigma[1]:.2f}")
    off_px = np.array([x_px, y_px]) - camera.axis_pixel
    console.print(
        f"  {'':16s} {math.hypot(*off_px):.1f} px "
        f"({rad_to_arcmin(camera.plate_scale_rad * math.hypot(*off_px)):.2f} arcmin) from the config's"
    )
    console.print(f"  {'verdict':16s} {calibration.verdict}")
    for remark in remarks:
        console.print(f"  {'':16s} {remark}")
    if out is None:
        console.print("Nothing was written. To keep it, say where with --out FILE.")
        return
    picture, png = picture_beside(out), figure_to_png(draw_axis(fit, positions, names, camera))
    write_calibration(out, calibration, force=force)
    write_file_durably(picture, png)
    console.print(f"Written: {out}, and a picture: {picture}")
    console.print(how_to_use(out, calibration))


def _check_choice(runs: list[Path], series: list[Path], *, is_twin: bool) -> None:
    if sum((bool(runs), bool(series), is_twin)) != 1:
        raise ConfigError(
            "say what the axis is to be found from: --run RUN (the facets' common centre), --held FRAMES (a star on "
            "the PSF camera's centre), or --twin for a rehearsal; one of the three"
        )


def _zeniths(zenith_deg: list[float], n_sources: int) -> list[float | None]:
    """Zenith distance of every source, rad; None when none is told."""
    if not zenith_deg:
        return [None] * n_sources
    if len(zenith_deg) != n_sources:
        raise ConfigError(
            f"--zenith-deg is given {len(zenith_deg)} times for {n_sources} measurements: give it once for each, in "
            "the same order, or not at all"
        )
    for angle in zenith_deg:
        if not 0.0 <= angle <= 90.0:
            raise ConfigError(f"--zenith-deg {angle:g}: must lie between 0 and 90 deg")
    return [deg_to_rad(angle) for angle in zenith_deg]


def _print_positions(console: Console, names: Sequence[str], positions: Sequence[AxisPosition]) -> None:
    table = Table("measurement", "zenith / deg", "column / px", "row / px", "points")
    for name, position in zip(names, positions, strict=True):
        sigma = np.sqrt(np.diag(position.covariance_px2))
        zenith = "" if position.zenith_rad is None else f"{rad_to_deg(position.zenith_rad):.0f}"
        column, row = (f"{position.pixel[k]:.2f} +- {sigma[k]:.2f}" for k in (0, 1))
        table.add_row(name, zenith, column, row, str(position.n_points))
    console.print(table)


def _remarks(
    fit: AxisFit, positions: Sequence[AxisPosition], camera: CameraModel, *, is_run: bool
) -> tuple[list[str], bool]:
    """What a person should know, and whether the axis is good for everything."""
    limits: list[str] = []
    notes: list[str] = []
    worst_rad = camera.plate_scale_rad * math.sqrt(float(np.linalg.eigvalsh(fit.covariance_px2)[-1]))
    if fit.is_moving:
        way_arcmin = rad_to_arcmin(camera.plate_scale_rad * fit.largest_way_px)
        (limits if way_arcmin > GOOD_ARCMIN else notes).append(
            f"the axis moves: by {fit.largest_way_px:.1f} px ({way_arcmin:.2f} arcmin) between measurements (by chance "
            f"less than once in {1.0 / max(fit.chance, 1e-6):.0f}). The mean is given, its uncertainty covers the "
            "motion; align at the zenith distance that matters most"
        )
    elif len(positions) > 1:
        notes.append(f"the measurements agree within their uncertainties (chance {fit.chance:.0%}): no flexure is seen")
    if not fit.is_moving and rad_to_arcmin(worst_rad) > GOOD_ARCMIN:
        limits.append(f"known to {rad_to_arcmin(worst_rad):.1f} arcmin only: record more")
    if np.isfinite(fit.slope_px_per_rad).all() and fit.is_moving:
        per_deg = [deg_to_rad(float(value)) for value in fit.slope_px_per_rad]
        doubt = [deg_to_rad(float(value)) for value in fit.slope_uncertainty_px_per_rad]
        notes.append(
            f"per degree of zenith distance: column {per_deg[0]:+.4f} +- {doubt[0]:.4f} px, row {per_deg[1]:+.4f} +- "
            f"{doubt[1]:.4f} px, were it a straight line"
        )
    if is_run:
        scatter_px = max(position.facet_scatter_px for position in positions)
        n_facets = min(position.n_points for position in positions)
        by_misalignment = rad_to_arcmin(camera.plate_scale_rad * scatter_px / math.sqrt(n_facets))
        notes.append(
            f"it is the centre of the light as the facets stand now, {scatter_px:.0f} px apart (rms per axis): tilts "
            f"at random put it {by_misalignment:.1f} arcmin off where the mirror's builders meant it"
        )
    else:
        notes.append(
            "only as exact as the star was held on the focal plane's centre: an arcmin off there is one off here"
        )
    return [*limits, *notes], not limits
