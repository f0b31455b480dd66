"""`namod-ctl calibrate dark`: what a camera shows without light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from namod_ctl.app.build.lamp_bench import TWIN_SEED, camera_at_bench, recording_range_s
from namod_ctl.app.build.stored_lamp_series import read_stored_darks
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    check_valid_days,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.commands.calibrate.radiometric import CalibratedCamera, Unit, ask, say
from namod_ctl.app.config.calibration_schema import DarkCalibration
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.lamp.dark_frames import MIN_EXPOSURE_RATIO, DarkCamera, measure_dark_frames
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.lamp_recording import dark_exposures_s, record_darks

N_FRAMES = 5


def dark(
    camera: Annotated[CalibratedCamera, typer.Argument(metavar="CAMERA", help="star or reflector.")],
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    out: Annotated[
        Path | None, typer.Option("--out", help="Calibration file.  [default: star_camera_dark.json]")
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option("--frames", help="Folder of stored dark frames; with series.csv those that it calls dark."),
    ] = None,
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse with the twin's camera.")] = False,
    exposure_unit: Annotated[
        Unit, typer.Option("--exposure-unit", help="Of the exposures in --frames.")
    ] = Unit.SECONDS,
    valid_days: Annotated[
        float, typer.Option("--valid-days", help="The calibration expires after so many days.")
    ] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace an older file.")] = False,
) -> None:
    """Measure bias, dark current, noise and hot pixels of a camera from frames with the cap on.

    Frames with light in them are refused.

    Example: namod-ctl calibrate dark star --twin --out star_dark.json
    """
    loaded = load_config(config)
    path = out or Path(f"{camera.role}_dark.json")
    if frames is not None and twin:
        raise ConfigError("--frames and --twin: choose one; stored frames need no twin")
    if frames is None and exposure_unit is not Unit.SECONDS:
        raise ConfigError("--exposure-unit is that of --frames; cameras are told seconds")
    check_calibration_output(path, force=force)
    check_valid_days(valid_days)
    section = loaded.star_camera if camera is CalibratedCamera.STAR else loaded.reflector_camera
    if frames is not None:
        darks = read_stored_darks(frames, section, exposure_unit.value, recording_range_s(loaded))
        source = f"{len(darks)} frames in {frames.resolve().name}"
    else:
        if twin:
            say("Rehearsal on the digital twin.")
        with camera_at_bench(loaded, camera.role, ask, is_twin=twin) as bench:
            bench.bench.cap()
            darks = record_darks(bench.camera, bench.clock, dark_exposures_s(bench.exposure_range_s), N_FRAMES)
        source = f"{len(darks)} frames of {'the twin with' if twin else 'the camera with'} its cap on"
    found = measure_dark_frames(darks, section.full_scale_adu)
    limits = _limits(found)
    header = new_header(
        section,
        camera.role,
        SystemClock(),
        source=source,
        verdict="limited" if limits else "good",
        remarks=tuple(limits),
        valid_days=valid_days,
        twin_seed=TWIN_SEED if twin else None,
    )
    calibration = dark_calibration(found, header)
    write_calibration(path, calibration, force=force)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(_table(found))
    console.print(f"Verdict: {calibration.verdict}")
    for limit in limits:
        console.print(f"  {limit}")
    console.print(f"Written to {path}.")
    console.print(how_to_use(path, calibration))


def dark_calibration(found: DarkCamera, header: dict[str, object]) -> DarkCalibration:
    """What the calibration file holds."""
    hot = zip(found.hot_xy.tolist(), found.hot_offset_adu.tolist(), found.hot_rate_adu_per_s.tolist(), strict=True)
    return DarkCalibration.model_validate(
        {
            **header,
            "kind": "dark",
            "bias_adu": round(found.bias_adu, 4),
            "rate_adu_per_s": round(found.rate_adu_per_s, 5),
            "read_noise_adu": round(found.read_noise_adu, 4),
            "fixed_pattern_adu": round(found.fixed_pattern_adu, 4),
            "hot_pixels": [(x, y, round(offset, 2), round(rate, 3)) for (x, y), offset, rate in hot],
        }
    )


def _limits(found: DarkCamera) -> list[str]:
    limits = []
    if not found.has_rate:
        limits.append(
            f"exposures {', '.join(f'{t:.3g}' for t in found.exposures_s)} s do not reach {MIN_EXPOSURE_RATIO:g} times "
            "apart: dark current is not known, levels hold for these exposures only"
        )
    if found.is_lost:
        limits.append(
            "almost all pixels show 0: the camera cuts its darkness off, so that faint light is lost too; raise its "
            "black level if it has one"
        )
    if found.n_frames < N_FRAMES:
        limits.append(f"{found.n_frames} frames only: cosmic rays may pass for hot pixels")
    return limits


def _table(found: DarkCamera) -> Table:
    table = Table(
        title=f"{found.n_frames} dark frames, exposures {found.exposures_s[0]:.3g} to {found.exposures_s[-1]:.3g} s"
    )
    for name in ("", "found", "uncertainty"):
        table.add_column(name, justify="left" if not name else "right")
    table.add_row("bias [adu]", f"{found.bias_adu:.3f}", f"{found.bias_uncertainty_adu:.3f}")
    table.add_row("dark current [adu/s]", f"{found.rate_adu_per_s:.4f}", f"{found.rate_uncertainty_adu_per_s:.4f}")
    table.add_row("read noise [adu]", f"{found.read_noise_adu:.3f}", "")
    table.add_row("fixed pattern [adu]", f"{found.fixed_pattern_adu:.3f}", "")
    table.add_row("hot pixels", str(len(found.hot_xy)), "")
    table.add_row("hits of cosmic rays, left out [pixels]", str(found.n_cosmic_rays), "")
    return table
