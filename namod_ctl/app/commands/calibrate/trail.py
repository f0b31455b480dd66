"""`namod-ctl calibrate trail`: plate scale, rotation and parity of the star camera from a star that trails."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from namod_ctl.app.build.camera_choice import DEFAULT_SIZE, open_chosen
from namod_ctl.app.build.frame_series import HOW_TO, FrameSeries, twin_of_runs
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.trail_source import Sighting, live_sightings, rehearse_trail, stored_sightings
from namod_ctl.app.calibration_files import (
    DEFAULT_VALID_DAYS,
    check_calibration_output,
    how_to_use,
    new_header,
    write_calibration,
)
from namod_ctl.app.config.calibration_schema import DistortionSection, GeometryCalibration
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.pictures.figure_style import figure_to_png, picture_beside
from namod_ctl.app.pictures.trail_picture import draw_trail
from namod_ctl.app.views.calibration_rows import values_in_words
from namod_ctl.calibration.geometry.star_streak import StreakFit, fit_streak
from namod_ctl.calibration.geometry.star_trail import TrailFit, fit_trail
from namod_ctl.calibration.geometry.trail_frames import FoundTrail, find_trail
from namod_ctl.calibration.sky.observed_sky import Site, julian_year
from namod_ctl.calibration.sky.star_catalogue import bright_stars, number_of_star
from namod_ctl.calibration.sky.star_path import StarPath, apparent_path, path_of_declination, place_of_date
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.frames import write_file_durably

GOOD_SHARE, WORST_SHARE = 3e-4, 3e-3
"""Of the plate scale: up to the first its uncertainty is good, beyond the second it is no calibration."""
DEFAULT_MINUTES, DEFAULT_EVERY_S = 15.0, 5.0
DEFAULT_SEED = 1
TWIN_DECLINATION_DEG = 16.5
NO_STARS = ("moon", "sun", "mercury", "venus", "mars", "jupiter", "saturn", "uranus", "neptune")

_LITTLE_AIR = Site(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Star:
    """Which star: its ICRS place (in this year), or its declination of date alone."""

    words: str
    place_rad: tuple[float, float] | None
    declination_rad: float

    def declination_at(self, moment: datetime | None) -> float:
        """Of date, where a place and a date are known."""
        if self.place_rad is None or moment is None:
            return self.declination_rad
        return place_of_date(moment, *self.place_rad, _LITTLE_AIR)[1]


def trail(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FRAMES]...",
            help="Files with their times, folders of such, or a run with --keep-frames all; one long exposure with a "
            "streak will do, too. Without any the star camera is used.",
        ),
    ] = None,
    star: Annotated[str | None, typer.Option(help="The star by name or number: Aldebaran, 'HIP 21421'.")] = None,
    j2000_deg: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="RA DEC", help="The star by its right ascension and declination, J2000."),
    ] = None,
    declination_deg: Annotated[
        float | None,
        typer.Option(help="The star by its declination of tonight (not J2000: that is up to 0.15 deg off)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the calibration, and a .png.")
    ] = None,
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")] = "fact",
    minutes: Annotated[float, typer.Option(min=0.5, max=240.0, help="Live: how long.")] = DEFAULT_MINUTES,
    every: Annotated[float, typer.Option(metavar="SECONDS", min=0.0, max=600.0, help="Live.")] = DEFAULT_EVERY_S,
    twin: Annotated[bool, typer.Option("--twin", help="Rehearse it on a digital twin.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the twin.")] = DEFAULT_SEED,
    valid_days: Annotated[float, typer.Option(help="How long the calibration holds.")] = DEFAULT_VALID_DAYS,
    force: Annotated[bool, typer.Option("--force", help="Replace an older file.")] = False,
) -> None:
    """Find the star camera's plate scale from a star that trails through its field while the drive is stopped.

    Point the telescope a little west of a bright star that stands alone, stop the drive, and let the star cross the
    field: 15 minutes make 3.7 degrees at the equator. Stars only: planets and the moon move on their own. With [site]
    in the config, times of day, and the star by name or J2000 place, refraction is taken out and rotation is told too.

    One trail cannot tell a wrong declination, a clock at a wrong rate or a drive that creeps from another plate scale:
    only its curvature may disagree, and is compared.

    Example: namod-ctl calibrate trail NIGHT/trail --star Aldebaran --out star_geometry.json
    """
    clock = SystemClock()
    loaded = load_config(config)
    instrument = build_instrument(loaded)
    chosen = _chosen_star(star, j2000_deg, declination_deg, clock.now(), is_twin=twin)
    if twin and frames:
        raise ConfigError("--twin makes frames of its own: leave FRAMES out, or --twin")
    if out is not None:
        check_calibration_output(out, force=force)
        check_calibration_output(picture_beside(out), force=force)
    site = _site(loaded)
    console = Console(soft_wrap=True, highlight=False, markup=False)
    true_camera = None
    series = FrameSeries(frames or [], "star_camera")
    sightings: Iterable[Sighting]
    if twin:
        has_path = chosen.place_rad is not None and site is not None
        place = chosen.place_rad if has_path else None
        rehearsal = rehearse_trail(instrument, clock, seed, place or chosen.declination_at(clock.now()), site)
        true_camera = rehearsal.true_camera
        console.print("Rehearsal: these are frames of a digital twin, not of your camera.", style="bold")
        with console.status("the twin's star trails"):
            sightings = list(rehearsal.sightings(instrument.star_camera, instrument.star_size_rad))
        source = f"digital twin, seed {seed}"
    elif frames:
        with console.status("looking for stars in the frames"):
            sightings = list(stored_sightings(series, instrument.star_camera, instrument.star_size_rad))
        source = ", ".join(str(path) for path in frames)
    else:
        with open_chosen("star", config, DEFAULT_SIZE, 255.0, is_twin=False) as camera:
            console.print(f"Taking frames for {minutes:g} minutes. The drive must be stopped.")
            sightings = list(live_sightings(camera, clock, 60.0 * minutes, every))
        source = f"live, {clock.now():%Y-%m-%d %H:%M} UTC"
    for problem in series.problems[:5]:
        console.print(f"left out: {problem}")
    if len(series.problems) > 5:
        console.print(f"and {len(series.problems) - 5} more")
    if not sightings:
        raise ConfigError(f"there is no frame that can be used; {HOW_TO}")
    header = {"source": f"{len(sightings)} frames of a trail of {chosen.words}; {source}", "valid_days": valid_days}
    twin_seed = seed if twin else twin_of_runs(frames or [])
    if len(sightings) == 1:
        calibration, png = _of_streak(sightings[0], chosen, loaded, instrument, header, twin_seed), None
    else:
        calibration, png = _of_trail(sightings, chosen, site, loaded, instrument, header, twin_seed)
    for name, words in values_in_words(calibration):
        console.print(f"  {name:16s} {words}")
    console.print(f"  {'verdict':16s} {calibration.verdict}")
    for remark in calibration.remarks:
        console.print(f"  {'':16s} {remark}")
    if true_camera is not None:
        true_mdeg = rad_to_mdeg(true_camera.plate_scale_rad)
        console.print(
            f"The twin's truth: {true_mdeg:.5f} mdeg per px, rotation "
            f"{rad_to_deg(true_camera.orientation.rotation_rad):.4f} deg."
        )
    if out is None:
        console.print("Nothing was written. To keep it, say where with --out FILE.")
        return
    write_calibration(out, calibration, force=force)
    if png is not None:
        write_file_durably(picture_beside(out), png)
        console.print(f"Written: {out}; look at {picture_beside(out)}: residuals must be without a pattern.")
    else:
        console.print(f"Written: {out}")
    console.print(how_to_use(out, calibration))


def _of_trail(
    sightings: list[Sighting],
    star: _Star,
    site: Site | None,
    config: InstrumentConfig,
    instrument: Instrument,
    header: dict[str, object],
    twin_seed: int | None,
) -> tuple[GeometryCalibration, bytes]:
    timed = sorted((s for s in sightings if math.isfinite(s.time_s)), key=lambda sighting: sighting.time_s)
    timed = [s for i, s in enumerate(timed) if i == 0 or s.time_s > timed[i - 1].time_s]
    time_s = np.array([sighting.time_s for sighting in timed])
    found = find_trail(time_s - time_s[0], [sighting.spots for sighting in timed])
    path, missing = _path(star, site, [timed[i] for i in found.frames], found)
    fit = fit_trail(found.trail, path, instrument.star_camera)
    camera = fit.camera
    relative = fit.plate_scale_uncertainty_rad / camera.plate_scale_rad
    remarks = [*fit.doubts, *fit.remarks, *missing, *_precision_remarks(relative)]
    if found.n_saturated:
        remarks.append(f"{found.n_saturated} frames with a saturated star were left out")
    has_rotation = math.isfinite(fit.rotation_uncertainty_rad)
    if has_rotation:
        remarks.append("the rotation is against the vertical; a mount whose azimuth axis leans adds its lean")
    bend = camera.distortion
    calibration = GeometryCalibration(
        **new_header(
            config.star_camera,
            "star_camera",
            SystemClock(),
            source=str(header["source"]),
            verdict="good" if not fit.doubts and relative <= GOOD_SHARE else "limited",
            remarks=tuple(remarks),
            valid_days=float(str(header["valid_days"])),
            twin_seed=twin_seed,
        ),
        kind="geometry",
        plate_scale_mdeg_per_px=rad_to_mdeg(camera.plate_scale_rad),
        plate_scale_uncertainty_mdeg_per_px=rad_to_mdeg(fit.plate_scale_uncertainty_rad),
        rotation_deg=rad_to_deg(camera.orientation.rotation_rad) if has_rotation else None,
        rotation_uncertainty_deg=rad_to_deg(fit.rotation_uncertainty_rad) if has_rotation else None,
        mirrored=None if fit.doubts else fit.is_mirrored,
        distortion=None
        if bend is None
        else DistortionSection(
            centre_px=(float(bend.centre_pixel[0]), float(bend.centre_pixel[1])),
            k1_per_rad2=bend.k1_per_rad2,
            k2_per_rad4=bend.k2_per_rad4,
        ),
        residual_rms_px=float(np.hypot(*fit.rms_px)),
        method="star trail",
        n_points=int(np.count_nonzero(fit.is_used)),
    )
    return calibration, _png(fit, found, instrument, star.words)


def _png(fit: TrailFit, found: FoundTrail, instrument: Instrument, words: str) -> bytes:
    return figure_to_png(draw_trail(fit, found.trail, instrument.star_camera, f"trail of {words}"))


def _path(star: _Star, site: Site | None, used: list[Sighting], found: FoundTrail) -> tuple[StarPath, list[str]]:
    """The star's true path, and what is missing for a better one."""
    utc = [sighting.utc for sighting in used if sighting.utc is not None]
    rough = [sighting.rough_utc for sighting in used if sighting.rough_utc is not None]
    missing = [
        words
        for words, is_missing in (
            ("[site] in the config", site is None),
            ("the star by --star or --j2000-deg", star.place_rad is None),
            ("times of day of the frames", len(utc) < len(used)),
        )
        if is_missing
    ]
    if site is not None and star.place_rad is not None and not missing:
        return apparent_path(utc, *star.place_rad, site), []
    moment = rough[0] if rough else None
    path = path_of_declination(found.trail.time_s, star.declination_at(moment))
    return path, [f"rotation is not told and refraction is only estimated: missing {', '.join(missing)}"]


def _of_streak(
    only: Sighting,
    star: _Star,
    config: InstrumentConfig,
    instrument: Instrument,
    header: dict[str, object],
    twin_seed: int | None,
) -> GeometryCalibration:
    """From the one frame there is: a long exposure."""
    assert only.image is not None
    try:
        fit = fit_streak(
            only.image,
            instrument.star_camera,
            instrument.star_size_rad,
            only.exposure_s,
            star.declination_at(only.rough_utc),
        )
    except DataQualityError as error:
        raise DataQualityError(f"{only.name}, the only frame: {error}") from None
    relative = fit.plate_scale_uncertainty_rad / fit.plate_scale_rad
    return GeometryCalibration(
        **new_header(
            config.star_camera,
            "star_camera",
            SystemClock(),
            source=str(header["source"]),
            verdict="limited",
            remarks=(*_streak_remarks(fit), *_precision_remarks(relative)),
            valid_days=float(str(header["valid_days"])),
            twin_seed=twin_seed,
        ),
        kind="geometry",
        plate_scale_mdeg_per_px=rad_to_mdeg(fit.plate_scale_rad),
        plate_scale_uncertainty_mdeg_per_px=rad_to_mdeg(fit.plate_scale_uncertainty_rad),
        residual_rms_px=fit.residual_rms_px,
        method="star streak",
        n_points=2,
    )


def _streak_remarks(fit: StreakFit) -> list[str]:
    length_px = float(np.linalg.norm(fit.ends_px[1] - fit.ends_px[0]))
    return [
        f"from one streak of {length_px:.0f} px: nothing confirms the declination, and that the drive stood still; "
        "many short exposures tell more"
    ]


def _precision_remarks(relative: float) -> list[str]:
    if relative > WORST_SHARE:
        raise DataQualityError(
            f"the plate scale is uncertain by {relative:.2%} (limit {WORST_SHARE:.1%}): let the star trail for longer, "
            "through the middle of the field, in more frames"
        )
    return [] if relative <= GOOD_SHARE else [f"the plate scale is known to {relative:.3%} only"]


def _chosen_star(
    star: str | None,
    j2000_deg: tuple[float, float] | None,
    declination_deg: float | None,
    now: datetime,
    *,
    is_twin: bool,
) -> _Star:
    if is_twin and star is None and j2000_deg is None and declination_deg is None:
        declination_deg = TWIN_DECLINATION_DEG
    if sum(given is not None for given in (star, j2000_deg, declination_deg)) != 1:
        raise ConfigError("say which star it is with one of --star, --j2000-deg and --declination-deg")
    if star is not None:
        if star.strip().lower() in NO_STARS:
            raise ConfigError(f"--star {star}: moves among the stars, so its rate is not the sky's; take a star")
        catalogue = bright_stars()
        number = number_of_star(catalogue, star)
        x, y, z = catalogue.directions(julian_year(now))[number]
        place = (math.atan2(float(y), float(x)) % math.tau, math.asin(float(z)))
        return _Star(star, place, place[1])
    if j2000_deg is not None:
        right_ascension_deg, declination_deg = j2000_deg
        _check_angle("--j2000-deg, right ascension", right_ascension_deg, 0.0, 360.0)
        _check_angle("--j2000-deg, declination", declination_deg, -85.0, 85.0)
        place = (deg_to_rad(right_ascension_deg), deg_to_rad(declination_deg))
        return _Star(f"the star at {right_ascension_deg:g}, {declination_deg:g} deg", place, place[1])
    assert declination_deg is not None
    _check_angle("--declination-deg", declination_deg, -85.0, 85.0)
    return _Star(f"a star of declination {declination_deg:g} deg", None, deg_to_rad(declination_deg))


def _check_angle(name: str, angle_deg: float, least: float, most: float) -> None:
    if not least <= angle_deg <= most:
        raise ConfigError(f"{name} {angle_deg:g}: must lie between {least:g} and {most:g} deg")


def _site(config: InstrumentConfig) -> Site | None:
    if config.site is None:
        return None
    return Site(deg_to_rad(config.site.latitude_deg), deg_to_rad(config.site.longitude_deg), config.site.altitude_m)
