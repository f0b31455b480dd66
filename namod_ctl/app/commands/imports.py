"""`namod-ctl import`: records that other programs made become a run."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.config.schema import TripodMountSection
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import REJECT_REASON_MEANING
from namod_ctl.core.units import m_to_mm, rad_to_deg, rad_to_mdeg
from namod_ctl.store.folders import check_output, is_run, partial_folder
from namod_ctl.store.import_maps import import_maps
from namod_ctl.store.import_namod import KeepFrames, import_namod
from namod_ctl.store.measure_files import MeasuringContext
from namod_ctl.store.namod_folder import CameraCalibration, NamodFolder, read_namod_folder
from namod_ctl.store.summary import ImportSummary

N_NAMED_RECORDS = 5
RECORDS_WORTH_A_PROCESS = 20  # starting one takes as long as measuring some records
EXIT_INTERRUPTED = 130  # what shells report for a program that was ended by Ctrl-C
SAME_ANGLE_DECIMALS = 12  # of a degree: takes the rounding of deg -> rad -> deg away

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Make a run of records that another program recorded.",
    epilog="Example: namod-ctl import maps response_maps --out RUN --config fact",
)

OutOption = Annotated[Path, typer.Option("--out", help="Folder of the new run; must not exist yet.")]
ConfigOption = Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or the name of a built-in one.")]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace an older run at --out once the new one is complete.")
]


@app.command("maps")
def maps(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder with files such as mirror_ID13_response_map.csv.")
    ],
    out: OutOption,
    config: ConfigOption = "fact",
    force: ForceOption = False,
) -> None:
    """Import response maps: one CSV file per facet, row i is the same record in every file.

    Example: namod-ctl import maps response_maps --out RUN --config fact
    """
    instrument_config = load_config(config)
    summary = import_maps(
        folder,
        out,
        config_facet_ids=[facet.id for facet in instrument_config.facets],
        plate_scale_rad=build_instrument(instrument_config).star_camera.plate_scale_rad,
        config_json=instrument_config.to_json(),
        clock=SystemClock(),
        force=force,
    )
    _print_summary(out, summary)


@app.command("namod")
def namod(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the original NAMOD program.")],
    out: OutOption,
    config: ConfigOption = "fact",
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", min=1, max=256, help="Processes that measure; if left out, as many as cores where it pays."
        ),
    ] = None,
    force: ForceOption = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an import to the same --out that was stopped.")
    ] = False,
    keep_frames: Annotated[KeepFrames, typer.Option(help="Frames to copy into the run.")] = KeepFrames.NONE,
) -> None:
    """Import a folder of the original program; all its frames are measured anew.

    Polygons, mounts and calibrations of the folder take the place of the config's. A record with a missing or
    damaged file is kept as rejected and named.

    Example: namod-ctl import namod sccan_2014_05_20 --out RUN --config fact
    """
    check_output(out, force=force)
    base = load_config(config)
    facet_order = [facet.id for facet in base.facets]
    found = read_namod_folder(folder, facet_order)
    used = with_calibrations_of(base, found)
    context = MeasuringContext(
        instrument=build_instrument(used),
        facet_ids=tuple(facet_id for facet_id in facet_order if facet_id in found.facet_map.polygons_px),
        star_calibration=found.star_camera,
        reflector_calibration=found.reflector_camera,
    )
    n_records = len(found.records)
    console = Console(stderr=True)
    bar = Progress(TextColumn("records"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console)
    try:
        with bar:
            task = bar.add_task("records", total=n_records)
            summary = import_namod(
                found.records,
                out,
                context=context,
                config_facet_ids=facet_order,
                config_json=used.to_json(),
                clock=SystemClock(),
                n_jobs=jobs or max(1, min(os.cpu_count() or 1, n_records // RECORDS_WORTH_A_PROCESS)),
                force=force,
                resume=resume,
                keep_frames=keep_frames,
                on_progress=lambda n_done: bar.update(task, completed=n_done),
            )
    except KeyboardInterrupt:
        if is_run(partial_folder(out)):
            hint = f"what is done lies in {partial_folder(out)}: go on with the same command and --resume"
        else:
            hint = "nothing was written"
        typer.echo(f"namod-ctl: stopped; {hint}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    _print_summary(out, summary)


def with_calibrations_of(config: InstrumentConfig, found: NamodFolder) -> InstrumentConfig:
    """The config with polygons, mounts and cameras as a folder of the original program has them.

    The files count pixels from the image's centre and their axes are the telescope frame's, so a camera's own
    rotation, mirroring and axis do not apply to them.

    Raises
    ------
    ConfigError
        The config's mounts are no tripods, or a value of the folder is implausible.
    """
    source = f"{found.facet_map.source} and the .int files beside it"
    if not isinstance(config.mount, TripodMountSection):
        raise ConfigError(
            f"{found.facet_map.source}: describes tripods, but the config's mount has kind = {config.mount.kind!r}; "
            "name a config with tripods with --config"
        )
    data = json.loads(config.to_json())
    data["mount"]["radius_m"] = found.facet_map.tripod_radius_m
    data["mount"]["pitch_mm_per_turn"] = m_to_mm(found.facet_map.pitch_m_per_turn)
    for facet_id, orientation_rad in found.facet_map.tripod_orientation_rad.items():
        orientation_deg = round(rad_to_deg(orientation_rad), SAME_ANGLE_DECIMALS)
        data["mount"]["facet_orientation_deg"][str(facet_id)] = orientation_deg
    data["reflector_map"] = {
        "polygons": [
            {"facet_id": facet_id, "corners_px": corners.tolist()}
            for facet_id, corners in found.facet_map.polygons_px.items()
        ]
    }
    _set_camera(data["star_camera"], found.star_camera, found.star_size_px)
    _set_camera(data["reflector_camera"], found.reflector_camera, found.reflector_size_px)
    return InstrumentConfig.from_json(json.dumps(data), source)


def _set_camera(section: dict[str, object], calibration: CameraCalibration, size_px: tuple[int, int]) -> None:
    n_columns, n_rows = size_px
    law = {"r_resp": calibration.law.r_resp, "r_expo": calibration.law.r_expo, "r_const": calibration.law.r_const}
    section |= {
        "columns": n_columns,
        "rows": n_rows,
        "rotation_deg": 0.0,
        "mirrored": False,
        "plate_scale_mdeg_per_px": rad_to_mdeg(calibration.plate_scale_rad),
        "radiometric_law": law,
    }
    if "axis_px" in section:  # it has an axis that is trusted: in these files that is the image's centre
        section["axis_px"] = [n_columns / 2.0, n_rows / 2.0]


def _print_summary(out: Path, summary: ImportSummary) -> None:
    console = Console(soft_wrap=True, highlight=False)
    console.print(
        f"{escape(str(out))}: {summary.n_records} records of {len(summary.facet_ids)} facets, "
        f"{summary.n_accepted} accepted, {summary.n_rejected} rejected"
    )
    for reason, rejections in summary.rejected.items():
        console.print(f"  {len(rejections)} {reason.name}: {REJECT_REASON_MEANING[reason]}")
        for rejection in rejections[:N_NAMED_RECORDS]:
            console.print(f"    {escape(rejection.label)}: {escape(rejection.detail)}")
        if len(rejections) > N_NAMED_RECORDS:
            console.print(f"    and {len(rejections) - N_NAMED_RECORDS} more")
    if summary.missing_facet_ids:
        ids = ", ".join(map(str, summary.missing_facet_ids))
        console.print(f"  facets of the config without data: ids {ids}")
    for remark in summary.remarks:
        console.print(f"  {escape(remark)}")
