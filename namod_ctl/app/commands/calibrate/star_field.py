"""`namod-ctl calibrate star-field`: the star camera's geometry from a field of stars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from namod_ctl.app.build.frame_series import FrameSeries
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.star_field_twin import twin_star_field
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.config.calibration_schema import GeometryCalibration
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.pictures.figure_style import figure_to_png, picture_beside
from namod_ctl.app.pictures.star_field_plot import draw_star_field
from namod_ctl.app.views.star_field_table import geometry_table, star_table, where_it_looked
from namod_ctl.calibration.geometry.field_geometry import FieldGeometry, Hint, Watch, solve_field
from namod_ctl.calibration.geometry.star_field import FrameStars, field_of_frames, stars_of_frame
from namod_ctl.calibration.sky.observed_sky import Site
from namod_ctl.calibration.sky.star_catalogue import EPOCH_YEAR, bright_stars, number_of_star
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.imaging.radiometry import Frame
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.frames import write_file_durably
from namod_ctl.twin.star_field import Lens

TWIN_SEED, TWIN_EXPOSURE_S, N_TWIN_FRAMES = 1, 1.0, 3
TWIN_TARGET = "Sadr"
LA_PALMA = Site(deg_to_rad(28.7616), deg_to_rad(-17.8911), 2195.0)
"""Of the twin when the config has no [site]."""

MAX_FRAMES = 100
LONGEST_S = 60.0
"""From the first frame to the last: in that time a field may turn by 0.2 deg, which moves its corners by 5 px."""


@dataclass(frozen=True, slots=True, eq=False)
class _Input:
    """What is to be solved; `truth` of the twin only."""

    images: list[NDArray[np.unsignedinteger[Any]]]
    names: list[str]
    moment: datetime | None
    site: Site | None
    source: str
    truth: Lens | None = None


def star_field(
    frames: Annotated[
        list[Path] | None, typer.Argument(metavar="[FRAMES]...", help="Frames of one field: files, folders or runs.")
    ] = None,
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    out: Annotated[Path, typer.Option("--out", help="Calibration file; its picture gets its name.")] = Path(
        "star_camera_geometry.json"
    ),
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse with the twin's camera and sky.")] = False,
    time: Annotated[
        str | None,
        typer.Option("--time", metavar="UTC", help="Middle of the frames, 2026-11-22T21:30:00; FITS files tell it."),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option("--site", metavar="LAT,LON,ALT", help="Degrees and metres; else the config's [site]."),
    ] = None,
    near: Annotated[
        str | None, typer.Option("--near", metavar="RA,DEC|STAR", help="Where the camera looked, degrees or a name.")
    ] = None,
    radius: Annotated[float, typer.Option("--radius", min=0.1, max=90, help="Within so many degrees of --near.")] = 5.0,
    valid_days: Annotated[
        float, typer.Option("--valid-days", help="The calibration expires after so many days.")
    ] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace older files.")] = False,
) -> None:
    """Calibrate the star camera's plate scale, rotation, mirroring and distortion from frames of a star field.

    Track a field with many bright stars (the Milky Way: Cygnus, Cassiopeia, Orion, Scorpius), at 30 to 65 degrees
    altitude, and take three to ten frames of 1 to 3 s, sharp and under a clear sky. Stars to magnitude 6.5 are
    recognized by themselves. With time and site the air's refraction is taken out and the rotation told.
    The frames must be taken within a minute.

    Example: namod-ctl calibrate star-field night/*.fits --config fact --near Sadr --out geometry.json
    """
    loaded = load_config(config)
    picture = picture_beside(out)
    check_calibration_output(out, force=force)
    check_calibration_output(picture, force=force)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    catalogue, instrument = bright_stars(), build_instrument(loaded)
    where = _site(site, loaded)
    if twin:
        if frames or time is not None:
            raise ConfigError("--twin makes its own frames at its own time: give neither FRAMES nor --time with it")
        console.print("Rehearsal on the digital twin.")
        target = int(np.argmax(catalogue.directions(EPOCH_YEAR) @ _direction(near or TWIN_TARGET)))
        made = twin_star_field(
            instrument, catalogue, where or LA_PALMA, target, N_TWIN_FRAMES, TWIN_EXPOSURE_S, TWIN_SEED
        )
        given = _Input(
            made.images,
            [f"frame {number}" for number in range(1, N_TWIN_FRAMES + 1)],
            made.moment,
            where or LA_PALMA,
            f"{N_TWIN_FRAMES} frames of the twin",
            made.lens,
        )
    else:
        given = _stored(frames or [], time, where)
    camera = instrument.star_camera
    found = [
        _stars(image, name, camera, instrument.star_size_rad)
        for image, name in zip(given.images, given.names, strict=True)
    ]
    field = field_of_frames(found, given.names, camera)
    hint = None if near is None else Hint(_direction(near), deg_to_rad(radius))
    watch = Watch(given.moment or SystemClock().now(), given.site if given.moment is not None else None)
    geometry = solve_field(field.stars, catalogue, camera, instrument.star_size_rad, watch, hint)
    calibration = _calibration(geometry, loaded, given, valid_days)
    title = f"{camera.name}: {given.source}, {len(field.stars.pixel)} lights"
    png = figure_to_png(draw_star_field(geometry, field.stars, camera, catalogue, title))
    write_calibration(out, calibration, force=force)
    write_file_durably(picture, png)
    console.print(star_table(geometry, field.stars.pixel, catalogue))
    console.print(geometry_table(geometry, camera))
    console.print(where_it_looked(geometry) + " Compare it with what the telescope says.")
    console.print(f"Verdict: {geometry.verdict}")
    for remark in geometry.remarks:
        console.print(f"  {remark}")
    if given.truth is not None:
        console.print(_truth(given.truth))
    console.print(f"Written to {out}, and the picture to {picture}: look at it.")
    console.print(how_to_use(out, calibration))


def _stars(image: Frame, name: str, camera: CameraModel, star_size_rad: float) -> FrameStars:
    try:
        return stars_of_frame(image, camera, star_size_rad)
    except (ConfigError, DataQualityError) as problem:
        raise type(problem)(f"{name}: {problem}") from None


def _stored(sources: list[Path], time: str | None, site: Site | None) -> _Input:
    if not sources:
        raise ConfigError("give frames of a star field (files, folders or runs), or rehearse with --twin")
    series = FrameSeries(sources, "star_camera", needs_exposure=False)
    read = list(series.frames())
    if series.problems:
        raise ConfigError("; ".join(series.problems[:5]) + ": take these out, or give whole frames")
    if len(read) > MAX_FRAMES:
        raise ConfigError(f"{len(read)} frames (at most {MAX_FRAMES}): ten of the same field are plenty")
    times = [frame.utc for frame in read if frame.utc is not None]
    span_s = (max(times) - min(times)).total_seconds() if times else 0.0
    if span_s > LONGEST_S:
        raise ConfigError(
            f"the frames were taken within {span_s:.0f} s (at most {LONGEST_S:g}): a field turns while it is "
            "tracked; give frames taken one right after the other"
        )
    if time is not None:
        moment: datetime | None = _moment(time)
    else:
        moment = datetime.fromtimestamp(float(np.mean([at.timestamp() for at in times])), UTC) if times else None
    source = f"{len(read)} frame(s): {read[0].name}" + (f" to {read[-1].name}" if len(read) > 1 else "")
    return _Input([frame.image for frame in read], [frame.name for frame in read], moment, site, source)


def _calibration(
    geometry: FieldGeometry, config: InstrumentConfig, given: _Input, valid_days: float
) -> GeometryCalibration:
    fit = geometry.match.fit
    plate = fit.plate
    when = f", {given.moment.isoformat(timespec='seconds')}" if given.moment is not None else ""
    header = new_header(
        config.star_camera,
        "star_camera",
        SystemClock(),
        source=f"{given.source}{when}",
        verdict=geometry.verdict,
        remarks=geometry.remarks,
        valid_days=valid_days,
        twin_seed=TWIN_SEED if given.truth is not None else None,
    )
    rotation, error = geometry.rotation_rad, geometry.rotation_uncertainty_rad
    return GeometryCalibration.model_validate(
        {
            **header,
            "kind": "geometry",
            "plate_scale_mdeg_per_px": rad_to_mdeg(plate.plate_scale_rad),
            "plate_scale_uncertainty_mdeg_per_px": rad_to_mdeg(geometry.plate_scale_uncertainty_rad),
            "rotation_deg": None if rotation is None else rad_to_deg(rotation),
            "rotation_uncertainty_deg": None if error is None else rad_to_deg(error),
            "mirrored": plate.is_mirrored,
            "distortion": {
                "centre_px": [float(value) for value in plate.centre_pixel],
                "k1_per_rad2": plate.k1_per_rad2,
                "k2_per_rad4": plate.k2_per_rad4,
            },
            "residual_rms_px": fit.rms_px,
            "method": "star field",
            "n_points": int(fit.is_used.sum()),
        }
    )


def _truth(lens: Lens) -> str:
    return (
        f"The twin's truth: {rad_to_mdeg(lens.plate_scale_rad):.5f} mdeg per px, rotation "
        f"{rad_to_deg(lens.rotation_rad):.4f} deg, {'mirrored' if lens.is_mirrored else 'not mirrored'}."
    )


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"--time {text}: write UTC as 2026-11-22T21:30:00") from None
    return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)


def _site(text: str | None, config: InstrumentConfig) -> Site | None:
    if text is None:
        known = config.site
        if known is None:
            return None
        return Site(deg_to_rad(known.latitude_deg), deg_to_rad(known.longitude_deg), known.altitude_m)
    values = _numbers(text)
    if len(values) != 3 or abs(values[0]) > 90.0 or abs(values[1]) > 360.0 or not -500.0 <= values[2] <= 9000.0:
        raise ConfigError(
            f"--site {text}: write latitude and longitude in degrees (north and east positive) and the altitude in "
            "metres, such as 28.7616,-17.8911,2195"
        )
    return Site(deg_to_rad(values[0]), deg_to_rad(values[1]), values[2])


def _direction(text: str) -> NDArray[np.float64]:
    """Unit vector of `--near`."""
    catalogue = bright_stars()
    if "," not in text:
        return np.asarray(catalogue.directions(EPOCH_YEAR)[number_of_star(catalogue, text)])
    values = _numbers(text)
    if len(values) != 2 or not 0.0 <= values[0] <= 360.0 or abs(values[1]) > 90.0:
        raise ConfigError(
            f"--near {text}: write right ascension (0 to 360) and declination in degrees, such as 305.56,40.26, or "
            "a star"
        )
    ra, dec = deg_to_rad(values[0]), deg_to_rad(values[1])
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


def _numbers(text: str) -> list[float]:
    try:
        return [value for value in map(float, text.split(",")) if math.isfinite(value)]
    except ValueError:
        return []
