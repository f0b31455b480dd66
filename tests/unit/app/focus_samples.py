"""Frames of a star of known size, seen by a camera that nobody has to open."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.camera_choice import ChosenCamera
from namod_ctl.app.focus_page.beside import FocusPage
from namod_ctl.app.views.camera_views import Look
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.cycle.focus import FocusCourse, read_focus
from namod_ctl.imaging.exposure import ExposureVerdict, frame_statistics
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation

N_COLUMNS, N_ROWS = 640, 480
ARCMIN_PER_PX = 0.25
SHORTEST_S = 1e-3


class ShutCamera:
    """Has a name and a range, and is asked for nothing."""

    name = "a camera"
    exposure_range_s = (SHORTEST_S, 3.0)

    def start(self, exposure_s: float) -> None:
        raise AssertionError("nobody should expose")

    def fetch(self, timeout_s: float) -> Exposure:
        raise AssertionError("nobody should expose")

    def close(self) -> None:
        pass


def chosen_camera(*, has_plate_scale: bool = True) -> ChosenCamera:
    """A linear camera of 8 bit in which a star in focus is 6 pixel wide."""
    model = CameraModel(
        name="a camera",
        n_columns=N_COLUMNS,
        n_rows=N_ROWS,
        plate_scale_rad=arcmin_to_rad(ARCMIN_PER_PX),
        axis_pixel=np.array([N_COLUMNS / 2.0, N_ROWS / 2.0]),
        axis_is_calibrated=False,
        orientation=CameraOrientation(0.0, False),
        law=RadiometricLaw(1.0, -1.0, 0.0),
        full_scale_adu=255.0,
    )
    return ChosenCamera(
        ShutCamera(), model, 6.0 * arcmin_to_rad(ARCMIN_PER_PX), SystemMonotonicClock(), has_plate_scale
    )


def star_frame(
    fwhm_px: float, peak_adu: float = 180.0, x_px: float = 250.0, y_px: float = 200.0, seed: int = 1
) -> NDArray[np.uint8]:
    """A gaussian star on a sky of 8, with noise of 1.5 and a hot pixel."""
    y, x = np.mgrid[:N_ROWS, :N_COLUMNS]
    r2 = (x - x_px) ** 2 + (y - y_px) ** 2
    light = 8.0 + peak_adu * np.exp(-4.0 * math.log(2.0) * r2 / fwhm_px**2)
    light += np.random.default_rng(seed).normal(0.0, 1.5, light.shape)
    light[400, 600] = 255.0
    return np.clip(np.rint(light), 0.0, 255.0).astype(np.uint8)


def look_at(
    frame: NDArray[np.uint8], verdict: ExposureVerdict = ExposureVerdict.GOOD, exposure_s: float = 0.04
) -> Look:
    """As if the frame had been taken."""
    exposure = Exposure(frame, exposure_s, 0.0, 1)
    return Look(exposure, frame_statistics(frame, chosen_camera().model), verdict)


def show(page: FocusPage, at_s: float, course: FocusCourse, look: Look, chosen: ChosenCamera) -> None:
    """What the command does with every look."""
    reading = None
    if look.exposure is not None:
        reading = read_focus(look.exposure.image, chosen.model, chosen.star_size_rad)
        course.add(reading)
    page.show(at_s, look, reading, course.best_px, chosen, is_exposure_given=False)
