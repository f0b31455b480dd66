"""`namod-ctl rereduce`: a run with newer calibrations of its cameras, beside the run as it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.replay import new_run_of, replay_equipment
from namod_ctl.app.build.twin import instrument_on_twin
from namod_ctl.app.build.twin_note import NOTE_SEED, NOTE_SETTINGS
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.commands.reconstruct import DEFAULT_BIN_SIZE_DEG, reconstruct_in
from namod_ctl.app.config.calibrations import calibrations_of
from namod_ctl.app.config.instrument import CAMERA_SECTIONS, InstrumentConfig
from namod_ctl.app.rereduction import NOTE_REREDUCED, comparison_text, recalibrated_config
from namod_ctl.app.views.recording_view import TerminalView
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.records import Record
from namod_ctl.core.units import deg_to_rad
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.cycle.replay import CAMERAS
from namod_ctl.imaging.recalibrate import recalibrated, why_frames_are_needed
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.combine import NOTE_COMBINED
from namod_ctl.store.frames import write_file_durably
from namod_ctl.store.run import RunStore

COMPARISON_FILE = "rereduction.txt"
_COPIED_NOTES = (NOTE_SEED, NOTE_SETTINGS)


def rereduce(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of the run; it stays as it is.")],
    calibration: Annotated[
        list[Path],
        typer.Option("--calibration", metavar="FILE", help="A calibration file; name the option once for each."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="NEW", help="Folder of the new run.  [default: RUN-rereduced]")
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="expired|foreign", help="Let such calibrations pass, on your own account."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an older run at --out.")] = False,
    self_calibration: Annotated[
        bool,
        typer.Option(
            "--self-calibration/--no-self-calibration",
            help="Take out how responses depend on the star's brightness, before and after, as reconstruct does.",
        ),
    ] = True,
) -> None:
    """Reduce a run anew with newer calibrations of its cameras, and say what that changes.

    Frames that were kept are measured anew; without frames, the records' numbers are put on the new calibrations where
    that is exact (plate scale, rotation, axis, distortion, r_expo and r_const). The new run holds the calibrations it
    was made with, its results, and rereduction.txt.

    Example: namod-ctl rereduce NIGHT --calibration star_geometry.json
    """
    console = Console(highlight=False, soft_wrap=True, markup=False)
    accepted = tuple(accept or ())
    for word in accepted:
        if word not in ("expired", "foreign"):
            raise ConfigError(f"--accept {word}: must be expired or foreign")
    check_run(run)
    target = out if out is not None else run.resolve().with_name(f"{run.resolve().name}-rereduced")
    with RunStore.open(run) as old:
        if old.note(NOTE_COMBINED) is not None:
            raise ConfigError(f"{run}: is a combination of runs; re-reduce each of them, and combine them again")
        config = InstrumentConfig.from_json(old.config_json, f"{run}: config")
        recorded = datetime.fromisoformat(old.created_utc)
        new_config = recalibrated_config(config, calibration, accepted, recorded)
        before, after = instrument_on_twin(config), instrument_on_twin(new_config)
        records = old.records()
        framed = _records_with_frames(old, records)
        reasons = _why_frames(before, after)
        if not framed and reasons:
            raise ConfigError(
                f"{run}: no frames were kept, and only frames can follow a change of {'; '.join(reasons)}; name other "
                "calibrations, or record with --keep-frames all"
            )
        source = f"re-reduction of {old.path.name}"
        with new_run_of(old, target, new_config.to_json(), source, force=force) as new:
            if len(framed) == len(records) or reasons:
                _measure_anew(old, framed, new, new_config, after)
                if len(framed) < len(records):
                    console.print(f"{run}: {len(records) - len(framed)} of its records without frames left out")
            else:
                new.append([recalibrated(record, before, after) for record in records])
            for key in _COPIED_NOTES:
                if (note := old.note(key)) is not None:
                    new.set_note(key, note)
            new.set_note(NOTE_REREDUCED, f"{old.path.name} with {_named(new_config)}")
            new_records = new.records()
            with console.status("comparing"):
                first, second = (
                    reconstruct(tabulate_responses(of_run, ids), instrument, self_calibration=self_calibration)
                    for of_run, ids, instrument in (
                        (records, old.facet_ids, before),
                        (new_records, new.facet_ids, after),
                    )
                )
            text = comparison_text(first.alignment, second.alignment, records, new_records)
            reconstruct_in(
                new.path,
                DEFAULT_ESTIMATOR,
                deg_to_rad(DEFAULT_BIN_SIZE_DEG),
                SystemClock(),
                console,
                halves=False,
                self_calibration=self_calibration,
            )
            write_file_durably(new.path / COMPARISON_FILE, text.encode())
    console.print(f"{run.name}, with {_named(new_config)}")
    console.print(text)
    console.print(f"Written to {target}; {run} is as it was. Next: namod-ctl instruct {target}")


def _records_with_frames(run: RunStore, records: Sequence[Record]) -> list[Record]:
    kept = set.intersection(*(set(run.frame_files(camera)) for camera in CAMERAS))
    return [record for record in records if record.index in kept]


def _why_frames(before: Instrument, after: Instrument) -> list[str]:
    return [
        f"{reason} of the {name}"
        for name, old, new in (
            ("star camera", before.star_camera, after.star_camera),
            ("reflector camera", before.reflector_camera, after.reflector_camera),
        )
        for reason in why_frames_are_needed(old, new)
    ]


def _measure_anew(
    old: RunStore, records: list[Record], new: RunStore, config: InstrumentConfig, instrument: Instrument
) -> None:
    """The frames of the old run through the recorder, on the same path as from the sky."""
    settings = replace(build_record_settings(config), keep_frames=False)
    recorder = Recorder(replay_equipment(old, records), instrument, new, settings, None, iter(records))
    with TerminalView(Console(stderr=True, highlight=False), f"frames of {old.path.name}") as view:
        recorder.record(StopRule(n_records=None, duration_s=None, uncertainty_rad=None), view.show)


def _named(config: InstrumentConfig) -> str:
    return ", ".join(
        f"the {calibration.camera.replace('_', ' ')}'s {calibration.kind} calibration of {calibration.made_utc}"
        for role in CAMERA_SECTIONS
        for calibration in calibrations_of(getattr(config, role))
    )
