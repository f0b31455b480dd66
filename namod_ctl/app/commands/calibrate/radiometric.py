"""`namod-ctl calibrate radiometric`: how a camera answers to light, from a lamp at several distances or levels."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console

from namod_ctl.app.build.lamp_bench import TWIN_SEED, camera_at_bench, camera_model_of, recording_range_s
from namod_ctl.app.build.stored_lamp_frames import ExposureUnit
from namod_ctl.app.build.stored_lamp_series import read_stored_series
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    check_valid_days,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.config.calibration_schema import LawSection, RadiometricCalibration
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.pictures.figure_style import figure_to_png, picture_beside
from namod_ctl.app.pictures.radiometric_plot import draw_radiometric
from namod_ctl.app.views.radiometric_table import radiometric_table
from namod_ctl.calibration.lamp.exposure_ratio import exposure_ratio
from namod_ctl.calibration.lamp.lamp_series import Placement, at_distance, at_level
from namod_ctl.calibration.lamp.lamp_visits import visits_of
from namod_ctl.calibration.lamp.radiometric_verdict import (
    DISTANCE_ERROR_M,
    RadiometricFinding,
    calibrate_radiometric,
)
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import m_to_mm, mm_to_m
from namod_ctl.cycle.lamp_recording import (
    LampSeries,
    SeriesPlan,
    dark_exposures_s,
    record_darks,
    record_lamp_series,
)
from namod_ctl.store.frames import write_file_durably

N_DARKS = 3
DEFAULT_DISTANCE_ERROR_MM = m_to_mm(DISTANCE_ERROR_M)
MAX_DISTANCE_ERROR_MM = 100.0
DEFAULT_DISTANCES = "0.5,0.65,0.85,1.1,1.4,1.8,2.3,3,3.9,5"

_Say = Callable[[str], None]


class CalibratedCamera(StrEnum):
    """Cameras whose intensities the method uses."""

    STAR = "star"
    REFLECTOR = "reflector"

    @property
    def role(self) -> Literal["star_camera", "reflector_camera"]:
        """Its section of the config."""
        return "star_camera" if self is CalibratedCamera.STAR else "reflector_camera"


class Unit(StrEnum):
    """Of exposures in files."""

    SECONDS = "s"
    MILLISECONDS = "ms"
    MICROSECONDS = "us"


def radiometric(
    camera: Annotated[CalibratedCamera, typer.Argument(metavar="CAMERA", help="star or reflector.")],
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Calibration file; its picture gets its name.  [default: star_camera_radiometric.json]"
        ),
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            "--frames", help="Folder of stored frames with series.csv: file, exposure_s, distance_m or level, is_dark."
        ),
    ] = None,
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse with the twin's camera and lamp.")] = False,
    distances: Annotated[
        str, typer.Option("--distances", metavar="M,M,...", help="From the lamp to the diffuser, metres.")
    ] = DEFAULT_DISTANCES,
    levels: Annotated[
        str | None,
        typer.Option("--levels", metavar="L,L,...", help="Relative light of the lamp (filters) instead of distances."),
    ] = None,
    distance_error_mm: Annotated[
        float,
        typer.Option(
            "--distance-error-mm",
            help="How well distances from filament to diffuser are known, each and all together (1 sigma); the "
            "uncertainties count it.",
        ),
    ] = DEFAULT_DISTANCE_ERROR_MM,
    free_levels: Annotated[
        bool, typer.Option("--free-levels", help="Do not trust the levels: tells r_expo / r_resp only, writes no file.")
    ] = False,
    exposure_unit: Annotated[
        Unit, typer.Option("--exposure-unit", help="Of the exposures in --frames.")
    ] = Unit.SECONDS,
    valid_days: Annotated[
        float, typer.Option("--valid-days", help="The calibration expires after so many days.")
    ] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace older files.")] = False,
) -> None:
    """Calibrate how a camera answers to light: fit log I = r_resp log C + r_expo log T + r_const, with uncertainties.

    A diffuser (white paper) before the lens is lit by a lamp at several distances. Gain, gamma and everything else
    automatic must be off. The program takes dark frames first, then chooses exposures itself and says where to put the
    lamp. Calibrate both cameras with the same lamp and distances: then their intensities have one scale.

    Example: namod-ctl calibrate radiometric star --twin --out star_radiometric.json
    """
    loaded = load_config(config)
    path = out or Path(f"{camera.role}_radiometric.json")
    picture = picture_beside(path)
    if frames is not None and twin:
        raise ConfigError("--frames and --twin: choose one; stored frames need no twin")
    if frames is None and exposure_unit is not Unit.SECONDS:
        raise ConfigError("--exposure-unit is that of --frames; cameras are told seconds")
    if not 0.0 <= distance_error_mm <= MAX_DISTANCE_ERROR_MM:
        raise ConfigError(
            f"--distance-error-mm {distance_error_mm:g}: must be 0 to {MAX_DISTANCE_ERROR_MM:g} mm; measure the "
            "distances better than that, or give --levels"
        )
    check_valid_days(valid_days)
    if not free_levels:
        check_calibration_output(path, force=force)
        check_calibration_output(picture, force=force)

    if frames is not None:
        series = _stored(frames, loaded, camera, exposure_unit, say)
        source = f"{len(series.responses)} frames in {frames.resolve().name}"
    else:
        series = _recorded(loaded, camera, _placements(distances, levels), say, is_twin=twin)
        source = f"{len(series.responses)} frames of {'the twin of ' if twin else ''}a guided lamp series"
    assert series.patch is not None
    assert series.dark is not None
    section = loaded.star_camera if camera is CalibratedCamera.STAR else loaded.reflector_camera
    full_scale_adu, n_pixels = section.full_scale_adu, series.patch.n_pixels
    if free_levels:
        _say_ratio(series, n_pixels, full_scale_adu, section.radiometric_law.r_expo / section.radiometric_law.r_resp)
        return
    finding = calibrate_radiometric(
        series.responses, series.placements, series.dark, n_pixels, full_scale_adu, mm_to_m(distance_error_mm)
    )
    header = new_header(
        section,
        camera.role,
        SystemClock(),
        source=source,
        verdict=finding.verdict,
        remarks=_remarks(finding),
        valid_days=valid_days,
        twin_seed=TWIN_SEED if twin else None,
    )
    calibration = radiometric_calibration(finding, header)
    write_calibration(path, calibration, force=force)
    write_file_durably(picture, figure_to_png(draw_radiometric(finding, f"{section.model} ({camera} camera)")))
    console = Console(highlight=False, markup=False, soft_wrap=True)
    before = section.radiometric_law
    console.print(radiometric_table(finding, (before.r_resp, before.r_expo, before.r_const)))
    console.print(f"Verdict: {finding.verdict}")
    for remark in finding.remarks:
        console.print(f"  {remark}")
    console.print(f"Written to {path}, and the picture to {picture}: look at its residuals.")
    console.print(how_to_use(path, calibration))


def radiometric_calibration(finding: RadiometricFinding, header: dict[str, object]) -> RadiometricCalibration:
    """What the calibration file holds."""
    r_resp, r_expo, r_const, r_curve = (float(value) for value in finding.fit.parameters)
    return RadiometricCalibration.model_validate(
        {
            **header,
            "kind": "radiometric",
            "law": LawSection(name=finding.law_name, r_resp=r_resp, r_expo=r_expo, r_const=r_const, r_curve=r_curve),
            "covariance": [[float(value) for value in row] for row in finding.fit.covariance],
            "intensity_unit": _intensity_unit(finding),
            "saturation_share": finding.saturation_share,
            "usable_response_share": finding.usable_response_share,
            "usable_exposure_s": finding.usable_exposure_s,
            "residual_rms_share": finding.residual_rms_share,
        }
    )


def _intensity_unit(finding: RadiometricFinding) -> str:
    what = (
        "the lamp at 1 m from the diffuser" if finding.placements[0].distance_m is not None else "the lamp at level 1"
    )
    return (
        f"1 = {what}, mean of the lit pixels in the middle of the series; the other camera has the same scale if "
        "calibrated with the same lamp, diffuser and distances or levels"
    )


def _remarks(finding: RadiometricFinding) -> tuple[str, ...]:
    shortest_s, longest_s = (10.0 ** float(f(finding.visits.log_exposure)) for f in (np.min, np.max))
    untimed = () if finding.visits.has_time else ("the frames tell no times: their order stands for it",)
    return (
        *finding.remarks,
        *untimed,
        f"exposures were taken as seconds, {shortest_s:.3g} to {longest_s:.3g}; the fit cannot tell another unit of "
        "all of them, which would only change r_const",
        f"one pixel alone is rounded by 5 % of its light at {finding.smallest_share_for_pixel:.2g} of full scale; the "
        "usable range of response is that of means over many pixels",
    )


def _stored(folder: Path, config: InstrumentConfig, camera: CalibratedCamera, unit: Unit, say: _Say) -> LampSeries:
    section = config.star_camera if camera is CalibratedCamera.STAR else config.reflector_camera
    model = camera_model_of(config, camera.role)
    in_unit: ExposureUnit = unit.value
    return read_stored_series(folder, section, model, in_unit, recording_range_s(config), say)


def _placements(distances: str, levels: str | None) -> tuple[Placement, ...]:
    option, text = ("--distances", distances) if levels is None else ("--levels", levels)
    make = at_distance if levels is None else at_level
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(
            f"{option} {text}: write numbers with commas between them, such as {DEFAULT_DISTANCES}"
        ) from None
    if len(set(values)) < 2 or not all(0.0 < value < np.inf for value in values):
        raise ConfigError(
            f"{option} {text}: give at least two different positive numbers, better eight or ten; from one level of "
            "the lamp alone only r_expo / r_resp can be told"
        )
    return tuple(make(value) for value in values)


def _recorded(
    config: InstrumentConfig, camera: CalibratedCamera, placements: tuple[Placement, ...], say: _Say, *, is_twin: bool
) -> LampSeries:
    if is_twin:
        say("Rehearsal on the digital twin: its lamp moves by itself.")
    with camera_at_bench(config, camera.role, ask, is_twin=is_twin) as bench:
        law = bench.model.law
        plan = SeriesPlan(placements, bench.exposure_range_s, -law.r_expo / law.r_resp)
        say(f"{bench.camera.name}: dark frames first, then {len(placements) + 1} placements of the lamp")
        bench.bench.cap()
        darks = record_darks(bench.camera, bench.clock, dark_exposures_s(bench.exposure_range_s), N_DARKS)
        say(f"{len(darks)} dark frames, exposures from {darks[0].exposure_s:.3g} to {darks[-1].exposure_s:.3g} s")
        return record_lamp_series(bench.camera, bench.clock, bench.bench, plan, darks, bench.model.full_scale_adu, say)


def _say_ratio(series: LampSeries, n_pixels: int, full_scale_adu: float, by_config: float) -> None:
    assert series.dark is not None
    visits = visits_of(series.responses, series.placements, series.dark, n_pixels, full_scale_adu, 1.0)
    ratio = exposure_ratio(visits)
    say(
        f"r_expo / r_resp = {ratio.value:.4f} +- {ratio.uncertainty:.4f} from {ratio.n_visits} exposures at "
        f"{ratio.n_placements} level(s), whatever these are; the config says {by_config:.4f}"
    )
    say("Nothing was written: r_resp and r_const need a lamp at two known levels or more.")


def ask(text: str) -> None:
    """Tell somebody what to do, and wait for it. Raises ConfigError when nobody is there."""
    try:
        input(f"{text} Then press Enter: ")
    except EOFError:
        raise ConfigError("the series needs somebody at the keyboard; rehearse with --twin") from None


def say(text: str) -> None:
    """Print a line."""
    Console(highlight=False, soft_wrap=True, markup=False).print(text)
