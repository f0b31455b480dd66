"""`namod-ctl export`: the result of a reconstruction in the forms of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from namod_ctl import __version__
from namod_ctl.app.alignment_files import facet_table, read_alignment, table_to_ecsv, table_to_fits
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.export_scatter import scatter_of_runs, zenith_distances_deg
from namod_ctl.calibration.gravity.found_normals import tilts_of_theta
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.raytrace import tilted_normals
from namod_ctl.optics.reflector import FacetShape, Reflector
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.export_merlict import merlict_scenery
from namod_ctl.store.export_robast import robast_table
from namod_ctl.store.export_sim_telarray import sim_telarray_config
from namod_ctl.store.export_table import add_geometry
from namod_ctl.store.facet_lists import format_mars, format_sim_telarray
from namod_ctl.store.frames import write_file_durably
from namod_ctl.store.run import RunStore

Array = NDArray[np.float64]


class ExportFormat(StrEnum):
    """Forms that other programs read."""

    MARS = "mars"
    SIM_TELARRAY = "sim_telarray"
    MERLICT = "merlict"
    ROBAST = "robast"
    ECSV = "ecsv"
    FITS = "fits"


CONFIG_SUFFIX = ".cfg"


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """One reconstructed run as the writers need it.

    Attributes
    ----------
    normals
        Shape (n_facets, 3). Unit normals as found; of facets without an estimate, those of perfectly aligned ones.
    comments
        Where the numbers come from and what stands against them, for the head of a file.
    """

    reflector: Reflector
    alignment: Alignment
    normals: Array
    unknown_ids: tuple[int, ...]
    comments: list[str]


def export(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folder of a run that was reconstructed; sim_telarray: or several."),
    ],
    form: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="mars: reflector file of Mars/Ceres; sim_telarray: mirror list, and beside it a .cfg with the scatter "
            "of the tilts; merlict: scenery (.tar); robast: table (.csv); ecsv, fits: table of facets.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    zenith_deg: Annotated[
        str | None,
        typer.Option(
            metavar="Z,Z,...",
            help="sim_telarray: zenith distance of each run, in their order. [default: as the runs say]",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
) -> None:
    """Write the estimated orientations of the facets for another program.

    What each form means, its frame and its sources: docs/exports.md.

    Example: namod-ctl export runs/2014-05 --format merlict --out fact_as_found.tar

    Example: namod-ctl export runs/z10 runs/z30 runs/z50 --format sim_telarray --zenith-deg 10,30,50 --out fact.dat
    """
    if form is not ExportFormat.SIM_TELARRAY and len(runs) > 1:
        raise ConfigError(f"--format {form}: shows one run, but {len(runs)} are given; only sim_telarray takes several")
    if form is not ExportFormat.SIM_TELARRAY and zenith_deg is not None:
        raise ConfigError(f"--zenith-deg: --format {form} has no zenith distance; leave it out")
    paths = [out]
    if form is ExportFormat.SIM_TELARRAY:
        paths.append(out.with_suffix(CONFIG_SUFFIX))
        if out.suffix == CONFIG_SUFFIX:
            raise ConfigError(
                f"{out}: --out names the mirror list, the {CONFIG_SUFFIX} is written beside it; give a .dat"
            )
    for path in paths:
        _check_output(path, force)
    found = read_export(runs[0])
    if form is ExportFormat.SIM_TELARRAY:
        contents = _sim_telarray(runs, found, zenith_deg, out)
    else:
        contents = [_content(form, found)]
    for path, content in zip(paths, contents, strict=True):
        write_file_durably(path, content)
    typer.echo(f"{out}: {len(found.reflector.facets)} facets")
    if form is ExportFormat.SIM_TELARRAY:
        typer.echo(f"{paths[1]}: scatter of the facets' tilts")
    _warn(form, found, len(runs))


def _check_output(path: Path, force: bool) -> None:
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; --out takes the name of a file")
    if path.exists() and not force:
        raise ConfigError(f"{path}: the file exists; choose another name, or replace it with --force")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent}: this folder does not exist; make it first")


def read_export(run: Path) -> Export:
    """A reconstructed run. Raises ConfigError, also where its alignment is of another telescope."""
    with RunStore.open(run) as store:
        config_json = store.config_json
    alignment = read_alignment(run)
    reflector = build_instrument(InstrumentConfig.from_json(config_json, f"{run}: config")).reflector
    strange = sorted({facet.facet_id for facet in alignment.facets} - set(reflector.ids))
    if strange:
        raise ConfigError(
            f"{run}: the alignment has facets that the run's telescope has not: {', '.join(map(str, strange))}; "
            f"run `namod-ctl reconstruct {run}` anew"
        )
    normals, unknown_ids = estimated_normals(reflector, alignment)
    return Export(reflector, alignment, normals, unknown_ids, _comments(alignment, unknown_ids))


def estimated_normals(reflector: Reflector, alignment: Alignment) -> tuple[Array, tuple[int, ...]]:
    """Unit normals (n_facets, 3) as found, telescope frame, and the ids of the facets without an estimate.

    A facet's normal is the one that has its light's centre of gravity where it was found, relative to the axis that
    corrections aim at. Facets without an estimate keep the normal of a perfectly aligned one.
    """
    theta_of = {facet.facet_id: facet.theta_rad - alignment.axis_rad for facet in alignment.facets}
    nothing = np.full(2, np.nan)
    tilt_rad = tilts_of_theta(reflector, np.array([theta_of.get(facet_id, nothing) for facet_id in reflector.ids]))
    is_known = np.asarray(np.isfinite(tilt_rad).all(axis=1))
    unknown_ids = tuple(facet_id for facet_id, is_in in zip(reflector.ids, is_known, strict=True) if not is_in)
    return tilted_normals(reflector, np.where(is_known[:, None], tilt_rad, 0.0)), unknown_ids


def _comments(alignment: Alignment, unknown_ids: tuple[int, ...]) -> list[str]:
    """Where the normals come from."""
    comments = [
        f"{alignment.telescope}: normals as found by namod-ctl {__version__}, estimator {alignment.estimator}, "
        f"{alignment.n_used} of {alignment.n_records} records",
    ]
    if unknown_ids:
        comments.append(f"no estimate, normal of the perfectly aligned facet: {' '.join(map(str, unknown_ids))}")
    unreliable = [str(facet.facet_id) for facet in alignment.facets if facet.flags.forbids_turning]
    unreliable = [facet_id for facet_id in unreliable if int(facet_id) not in unknown_ids]
    if unreliable:
        comments.append(f"estimate not reliable enough to turn a bolt on: {' '.join(unreliable)}")
    return comments


def _content(form: ExportFormat, found: Export) -> bytes:
    match form:
        case ExportFormat.MARS:
            head = "".join(f"# {comment}\n" for comment in found.comments)
            return (head + format_mars(found.reflector, found.normals)).encode()
        case ExportFormat.MERLICT:
            return merlict_scenery(found.reflector, found.normals, found.comments)
        case ExportFormat.ROBAST:
            return robast_table(found.reflector, found.normals, found.comments).encode()
        case _:
            table = facet_table(found.alignment)
            is_unknown = np.isin(found.reflector.ids, found.unknown_ids)
            add_geometry(table, found.reflector, np.where(is_unknown[:, None], np.nan, found.normals))
            return table_to_fits(table) if form is ExportFormat.FITS else table_to_ecsv(table)


def _sim_telarray(runs: Sequence[Path], found: Export, zenith_deg: str | None, out: Path) -> list[bytes]:
    """The mirror list and the lines of the configuration."""
    scatter, remarks = scatter_of_runs(runs, zenith_distances_deg(zenith_deg, len(runs)))
    found_in = "a run" if len(runs) == 1 else f"{len(runs)} runs"
    telescope = found.alignment.telescope
    comments = [f"{telescope}: scatter of the facets' tilts, found by namod-ctl {__version__} in {found_in}", *remarks]
    config = sim_telarray_config(found.reflector, out.name, scatter, comments, has_zenith_terms=len(runs) > 1)
    return [format_sim_telarray(found.reflector).encode(), config.encode()]


def _warn(form: ExportFormat, found: Export, n_runs: int) -> None:
    """Say what the files do not tell."""
    if found.unknown_ids and form in (ExportFormat.MARS, ExportFormat.MERLICT, ExportFormat.ROBAST):
        listed = ", ".join(map(str, found.unknown_ids))
        typer.echo(f"No estimate, so written as perfectly aligned: facets {listed}.", err=True)
    if form is ExportFormat.MARS and any(facet.shape is not FacetShape.HEXAGON for facet in found.reflector.facets):
        typer.echo(
            "Mars/Ceres: only hexagons could be compared with a file of theirs; check how your version reads type and "
            "size of square and round facets.",
            err=True,
        )
    if form is ExportFormat.SIM_TELARRAY and n_runs == 1:
        typer.echo(
            "One run: the scatter holds for its zenith distance only. Give runs at several zenith distances for the "
            "zenith terms.",
            err=True,
        )
