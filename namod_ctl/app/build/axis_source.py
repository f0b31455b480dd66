"""Measurements of the optical axis: from runs, from frames of a held star, or from a twin that holds one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from namod_ctl.app.build.frame_series import HOW_TO, FrameSeries
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.calibration.geometry.optical_axis import AxisPosition, axis_of_facets, axis_of_held_star
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.imaging.measure import without_dark
from namod_ctl.imaging.radiometry import Frame, grey_frame, saturation_adu
from namod_ctl.imaging.star import Star, StarRejection, star_finder
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.run import RunStore
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.sky import LightTrack
from namod_ctl.twin.star_frame import StarFrames

TWIN_ZENITH_DEG = (10.0, 30.0, 50.0, 65.0)
TWIN_FRAMES = 15
TWIN_EXPOSURE_S = 0.05
TWIN_AXIS_RAD = arcmin_to_rad(3.0)
"""How far the twin's axis lies from the config's, per axis; and what flexure moves it by towards the horizon."""
TWIN_FLEXURE_RAD = arcmin_to_rad(0.4)
TWIN_HUNTING_RAD = arcmin_to_rad(0.08)


def run_position(path: Path, camera: CameraModel, zenith_rad: float | None) -> AxisPosition:
    """The axis from the facets of a run, in the image of `camera`.

    Raises
    ------
    ConfigError
        There is no run, or it was recorded with another star camera, or with another geometry of it.
    DataQualityError
        The run is no use.
    """
    check_run(path)
    with RunStore.open(path) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{path}: config"))
        table = tabulate_responses(store.records(), store.facet_ids)
    _check_camera(path, instrument.star_camera, camera)
    return axis_of_facets(reconstruct(table, instrument), instrument.star_camera, zenith_rad)


def _check_camera(path: Path, recorded: CameraModel, camera: CameraModel) -> None:
    size, wanted = (recorded.n_columns, recorded.n_rows), (camera.n_columns, camera.n_rows)
    if recorded.name != camera.name or size != wanted:
        raise ConfigError(
            f"{path}: recorded with the star camera {recorded.name} of {size[0]} x {size[1]} px, the config's is "
            f"{camera.name} of {wanted[0]} x {wanted[1]} px: give the config of the run's telescope"
        )


def held_position(
    path: Path, camera: CameraModel, star_size_rad: float, zenith_rad: float | None, tell: Callable[[str], None]
) -> AxisPosition:
    """The axis from frames in which the star was held; frames without one star are left out, and told.

    Raises
    ------
    ConfigError
        There are no frames, or they are of another camera.
    DataQualityError
        Too few show the star, or it was not held.
    """
    series = FrameSeries([path], "star_camera", needs_exposure=camera.dark is not None)
    stars: list[Star] = []
    for frame in series.frames():
        try:
            found = _star(frame.image, camera, star_size_rad, frame.exposure_s)
        except ConfigError as error:
            raise ConfigError(f"{frame.name}: {error}") from None
        if isinstance(found, StarRejection):
            series.problems.append(f"{frame.name}: {found.detail}")
        else:
            stars.append(found)
    for problem in series.problems[:5]:
        tell(f"left out: {problem}")
    if len(series.problems) > 5:
        tell(f"and {len(series.problems) - 5} more")
    if not stars and not series.problems:
        raise ConfigError(f"{path}: there is no frame; {HOW_TO}")
    return _of_stars(stars, camera, star_size_rad, zenith_rad)


def _star(image: Frame, camera: CameraModel, star_size_rad: float, exposure_s: float) -> Star | StarRejection:
    grey = grey_frame(without_dark(image, camera, exposure_s), saturation_adu(camera))
    return star_finder(camera, star_size_rad, grey.dtype).find(grey)


def _of_stars(stars: list[Star], camera: CameraModel, star_size_rad: float, zenith_rad: float | None) -> AxisPosition:
    pixel = np.array([(star.x_px, star.y_px) for star in stars]).reshape(-1, 2)
    uncertainty_px = np.array([star.uncertainty_px for star in stars])
    return axis_of_held_star(pixel, uncertainty_px, star_size_rad / camera.plate_scale_rad, zenith_rad)


def rehearse_held(instrument: Instrument, seed: int) -> list[AxisPosition]:
    """Measurements of a twin's axis, which is not where the config says and moves with the zenith distance."""
    rng = generator(seed, "true optical axis")
    camera = instrument.star_camera
    axis_rad, sag_rad = rng.normal(0.0, TWIN_AXIS_RAD, 2), rng.normal(0.0, TWIN_FLEXURE_RAD, 2)
    frames = StarFrames(Sensor(camera, STAR_CAMERA, "star", seed), instrument.star_size_rad, seed)
    positions = []
    for zenith_rad in (deg_to_rad(angle) for angle in TWIN_ZENITH_DEG):
        stars = []
        for _ in range(TWIN_FRAMES):
            theta = axis_rad + sag_rad * np.sin(zenith_rad) + rng.normal(0.0, TWIN_HUNTING_RAD, 2)
            track = LightTrack(theta[None, :], np.array([0.6]), 0.0)
            image = frames.render([track], 1.0, (STAR_CAMERA.background_share, np.zeros(2)), TWIN_EXPOSURE_S, rng)
            found = _star(image, camera, instrument.star_size_rad, TWIN_EXPOSURE_S)
            if isinstance(found, Star):
                stars.append(found)
        positions.append(_of_stars(stars, camera, instrument.star_size_rad, zenith_rad))
    return positions
