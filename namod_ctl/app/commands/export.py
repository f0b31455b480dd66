"""`namod-ctl export`: the result of a reconstruction in the forms of other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from namod_ctl.app.alignment_files import facet_table, read_alignment, table_to_ecsv, table_to_fits
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.coordinates import correction_of_theta
from namod_ctl.optics.raytrace import tilted_normals
from namod_ctl.optics.reflector import Reflector
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.facet_lists import format_mars
from namod_ctl.store.frames import write_file_durably
from namod_ctl.store.run import RunStore

Array = NDArray[np.float64]


class ExportFormat(StrEnum):
    """Forms that other programs read."""

    MARS = "mars"
    ECSV = "ecsv"
    FITS = "fits"


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run that was reconstructed.")],
    form: Annotated[
        ExportFormat,
        typer.Option("--format", help="mars: reflector file with the estimated normals; ecsv, fits: table of facets."),
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
) -> None:
    """Write the estimated orientations of the facets for another program.

    Example: namod-ctl export runs/2014-05 --format mars --out fact_as_found.txt
    """
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; --out takes the name of a file")
    if out.exists() and not force:
        raise ConfigError(f"{out}: the file exists; choose another name, or replace it with --force")
    if not out.parent.is_dir():
        raise ConfigError(f"{out.parent}: this folder does not exist; make it first")
    with RunStore.open(run) as store:
        config_json = store.config_json
    alignment = read_alignment(run)
    if form is not ExportFormat.MARS:
        table = facet_table(alignment)
        data = table_to_fits(table) if form is ExportFormat.FITS else table_to_ecsv(table)
        write_file_durably(out, data)
        typer.echo(f"{out}: {len(alignment.facets)} facets")
        return
    reflector = build_instrument(InstrumentConfig.from_json(config_json, f"{run}: config")).reflector
    normals, unknown_ids = estimated_normals(reflector, alignment)
    write_file_durably(out, mars_text(reflector, normals, unknown_ids, alignment).encode())
    typer.echo(f"{out}: {len(reflector.facets)} facets")
    if unknown_ids:
        typer.echo(
            f"No estimate, so written as perfectly aligned: facets {', '.join(map(str, unknown_ids))}.", err=True
        )


def estimated_normals(reflector: Reflector, alignment: Alignment) -> tuple[Array, tuple[int, ...]]:
    """Unit normals (n_facets, 3) as found, telescope frame, and the ids of the facets without an estimate.

    A facet's tilt is what its correction, towards the axis that corrections aim at, would take away. Facets without
    an estimate keep the normal of a perfectly aligned one.
    """
    tilts_rad = {
        facet.facet_id: -correction_of_theta(facet.theta_rad - alignment.axis_rad)
        for facet in alignment.facets
        if np.all(np.isfinite(facet.theta_rad))
    }
    tilt_rad = np.array([tilts_rad.get(facet_id, np.zeros(2)) for facet_id in reflector.ids])
    unknown_ids = tuple(facet_id for facet_id in reflector.ids if facet_id not in tilts_rad)
    return tilted_normals(reflector, tilt_rad), unknown_ids


def mars_text(reflector: Reflector, normals: Array, unknown_ids: tuple[int, ...], alignment: Alignment) -> str:
    """The reflector file, headed by where the normals come from."""
    comments = [
        f"# {alignment.telescope}: normals as found by namod-ctl, estimator {alignment.estimator}, "
        f"{alignment.n_used} of {alignment.n_records} records",
    ]
    if unknown_ids:
        comments.append(f"# no estimate, normal of the perfectly aligned facet: {' '.join(map(str, unknown_ids))}")
    unreliable = [str(facet.facet_id) for facet in alignment.facets if facet.flags.forbids_turning]
    unreliable = [facet_id for facet_id in unreliable if int(facet_id) not in unknown_ids]
    if unreliable:
        comments.append(f"# estimate not reliable enough to turn a bolt on: {' '.join(unreliable)}")
    return "\n".join(comments) + "\n" + format_mars(reflector, normals)
