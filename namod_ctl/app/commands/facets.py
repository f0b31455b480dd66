"""`namod-ctl facets`: where the facets are in the reflector camera's image."""

from __future__ import annotations

from itertools import chain, count
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from namod_ctl.app.commands.instruct import read_picture
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.facet_editor.workbench import Workbench, open_workbench
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.polygons import map_faults
from namod_ctl.store.facet_tables import read_polygon_table
from namod_ctl.store.results import write_results

app = typer.Typer(
    add_completion=False,
    rich_markup_mode="markdown",
    help="Make and check the map of the facets in the reflector camera's image.",
    epilog="Example: namod-ctl facets check --config fact",
    no_args_is_help=True,
)

ImageOption = Annotated[
    Path,
    typer.Option(help="Picture by the reflector camera in which facets can be seen: its whole frame, at any size."),
]
ConfigOption = Annotated[str, typer.Option(help="Instrument: a TOML file, or a built-in name.")]
OutOption = Annotated[
    Path | None, typer.Option(help="CSV file to write the map to. Default: the polygons_file that the config names.")
]


@app.command("edit")
def edit(
    image: ImageOption,
    config: ConfigOption = "fact",
    out: OutOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 takes a free one.")] = 0,
) -> None:
    """Draw the map in the browser: mark 4 facets (better 6), and all outlines follow.

    Example: namod-ctl facets edit --image reflector.png --config my_telescope.toml
    """
    from namod_ctl.app.facet_editor.server import serve  # its libraries are not needed by the other commands

    serve(_workbench(config, image, out), port, announce=typer.echo)


@app.command("propose")
def propose(
    image: ImageOption,
    config: ConfigOption = "fact",
    out: OutOption = None,
    marks: Annotated[
        Path | None,
        typer.Option(
            help="CSV file facet_id,x_px,y_px of facets in the picture: a row for a centre, or one per corner."
        ),
    ] = None,
    edges: Annotated[
        bool, typer.Option(help="Also fit the edges that are visible in the picture; needed without marks.")
    ] = True,
) -> None:
    """Make the map without a browser, from marks in a file, from visible edges, or both.

    A map that is replaced, the config's own as well, is kept beside the new one, with .bak after its name.

    Example: namod-ctl facets propose --image reflector.png --marks marks.csv --out my_polygons.csv
    """
    bench = _workbench(config, image, out)
    marks_px = read_polygon_table(marks) if marks is not None else {}
    if not marks_px and not edges:
        raise ConfigError("nothing to go by: give --marks, or leave --no-edges out")
    how: list[str] = []
    pose = None
    notes: list[str] = []
    if marks_px:
        solution = bench.solve(marks_px)
        pose, notes = solution.pose, bench.mark_notes(solution)
        how.append(f"camera pose from {len(marks_px)} marked facets, {solution.rms_px:.2f} px rms")
        typer.echo(f"{len(marks_px)} marks fit with {solution.rms_px:.2f} px rms:")
        for facet_id, residual_px in solution.residual_px.items():
            typer.echo(f"  facet {facet_id}: {residual_px:.2f} px")
    if edges:
        proposal = bench.propose(marks_px)
        if proposal.doubts:
            for doubt in proposal.doubts:
                typer.echo(f"Edges not used: {doubt}.")
            if pose is None:
                raise ConfigError("the picture's edges alone do not suffice: give --marks")
        else:
            pose, notes = proposal.fit.pose, []
            fit = proposal.fit
            how.append(f"fitted to the edges of {fit.seen_share:.0%} of the facets, {fit.rms_px:.2f} px rms")
            typer.echo(f"Edges of {fit.seen_share:.0%} of the facets found, {fit.rms_px:.2f} px rms.")
    if pose is None:
        raise ValueError("no pose, and no reason why")
    for note in notes + bench.notes(pose):
        typer.echo(f"Note: {note}.")
    outlines = bench.outlines_px(pose)
    kept = _keep_old(bench.out)
    written = bench.save(outlines, is_missing_confirmed=True, how="; ".join(how))
    if kept is not None:
        typer.echo(f"The map that was there is kept as {kept}.")
    typer.echo(f"{len(outlines)} outlines written to {written}. {bench.next_step()}")


def _keep_old(path: Path | None) -> Path | None:
    """A copy of the file beside it, under a name that was free; None where there is no such file."""
    if path is None or not path.is_file():
        return None
    names = (f"{path.name}.bak{number}" for number in chain([""], count(2)))
    kept = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    write_results(path.parent, {kept.name: path.read_bytes()})
    return kept


@app.command("check")
def check(
    config: ConfigOption = "fact",
    polygons: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MAP]",
            help="CSV file of a map for this instrument. Default: the config's own.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Check a map: every facet once, in the image, not crossing itself, not on another facet.

    Example: namod-ctl facets check my_polygons.csv --config my_telescope.toml
    """
    loaded = load_config(config)
    camera = loaded.reflector_camera
    if polygons is not None:
        outlines = read_polygon_table(polygons)
    else:
        outlines = {polygon.facet_id: np.array(polygon.corners_px) for polygon in loaded.polygons}
    name = polygons if polygons is not None else config
    if not outlines:
        raise ConfigError(f"{name}: there is no map; make one with namod-ctl facets edit")
    ids = [facet.id for facet in loaded.facets]
    problems = [f"facet {i}: the reflector has no facet of this id" for i in outlines if i not in ids]
    faults = map_faults(outlines, camera.columns, camera.rows)
    problems += [f"facet {i}: {text}" for i, texts in sorted(faults.items()) for text in texts]
    if problems:
        raise ConfigError("\n".join(f"{name}: {problem}" for problem in problems))
    missing = [facet_id for facet_id in ids if facet_id not in outlines]
    if missing:
        typer.echo(f"Without an outline, so never measured: facets {', '.join(map(str, missing))}.")
    typer.echo(f"{name}: {len(outlines)} outlines, sound.")


def _workbench(config: str, image: Path, out: Path | None) -> Workbench:
    pixels = read_picture(image)
    bench = open_workbench(config, image, pixels, out)
    if bench.out is None:
        raise ConfigError(
            f"{config}: this config keeps no map in a file of its own: give --out FILE, then put "
            '[reflector_map] polygons_file = "FILE" into your config'
        )
    if not bench.out.parent.is_dir():
        raise ConfigError(f"{bench.out}: the folder does not exist; make it, or give another --out")
    return bench
