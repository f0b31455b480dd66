"""From an image pair to a record: the one path of live recording, import and re-reduction."""

from __future__ import annotations

import numpy as np

from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.imaging.dark import Dark, dark_rest_adu, subtract_dark, subtract_dark_model
from namod_ctl.imaging.facets import FacetLight, FacetPhotometer
from namod_ctl.imaging.radiometry import Frame, checked_frame, exposure_factor, grey_frame, saturation_adu
from namod_ctl.imaging.star import Star, StarRejection, star_finder
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument

MAX_SATURATED_SHARE = 0.01
"""Of a facet's pixels: above, its mean intensity is too low by an unknown amount. Single hot pixels stay below."""

N_NAMED_FACETS = 5


def measure_record(
    star_frame: Frame,
    reflector_frame: Frame,
    star_exposure_s: float,
    reflector_exposure_s: float,
    instrument: Instrument,
    photometer: FacetPhotometer,
    index: int,
    label: str,
    star_dark: Dark | None = None,
    reflector_dark: Dark | None = None,
) -> Record:
    """The record of an image pair; it carries a reason when it does not count.

    Parameters
    ----------
    star_frame, reflector_frame
        Shape (rows, columns) or (rows, columns, 3), unsigned integers of 8 or 16 bit, as the cameras give them.
    photometer
        Of the facets to measure; its order is that of the record's facets.
    star_dark, reflector_dark
        What the cameras show without light at these exposures, taken off first; without them the dark models of the
        cameras' calibrations, where there are any, serve.

    Returns
    -------
    Record
        Facets are measured in any case, so that a rejected record can be looked at. Direction and intensity of the star
        are NaN when the star does not count. A facet that throws no light has the intensity 0, and counts.

    Raises
    ------
    ConfigError
        When a frame is not of the camera the instrument describes, or an exposure is no positive number.
    """
    star = _star(star_frame, star_exposure_s, instrument, star_dark)
    camera = instrument.reflector_camera
    light = photometer.measure(
        without_dark(reflector_frame, camera, reflector_exposure_s, reflector_dark),
        camera,
        reflector_exposure_s,
        _rest_adu(camera, reflector_exposure_s, reflector_dark),
    )
    saturated = _saturated_facets(light, photometer)
    reason: RejectReason | None = None
    detail = ""
    if isinstance(star, StarRejection):
        reason, detail = star.reason, star.detail
    elif saturated:
        reason, detail = RejectReason.REFLECTOR_SATURATED, saturated
    theta_rad, theta_uncertainty_rad, intensity = np.full(2, np.nan), np.nan, np.nan
    if isinstance(star, Star):
        theta_rad = instrument.star_camera.theta_of_pixel(np.array([star.x_px, star.y_px]))
        theta_uncertainty_rad = star.uncertainty_px * instrument.star_camera.plate_scale_rad
        intensity = star.intensity_sum * exposure_factor(instrument.star_camera.law, star_exposure_s)
    return Record(
        index=index,
        label=label,
        theta_rad=theta_rad,
        theta_uncertainty_rad=theta_uncertainty_rad,
        star_intensity=intensity,
        facet_intensity=light.intensity,
        facet_saturated_share=light.saturated_share,
        star_exposure_s=star_exposure_s,
        reflector_exposure_s=reflector_exposure_s,
        reject_reason=reason,
        detail=detail,
    )


def _star(frame: Frame, exposure_s: float, instrument: Instrument, dark: Dark | None) -> Star | StarRejection:
    camera = instrument.star_camera
    exposure_factor(camera.law, exposure_s)
    grey = grey_frame(without_dark(frame, camera, exposure_s, dark), saturation_adu(camera))
    rest_adu = _rest_adu(camera, exposure_s, dark)
    return star_finder(camera, instrument.star_size_rad, grey.dtype, rest_adu).find(grey)


def _rest_adu(camera: CameraModel, exposure_s: float, dark: Dark | None) -> float:
    """What a frame that `without_dark` gives still shows without light."""
    return dark_rest_adu(camera.dark, exposure_s) if dark is None and camera.dark is not None else 0.0


def without_dark(frame: Frame, camera: CameraModel, exposure_s: float, dark: Dark | None = None) -> Frame:
    """The frame, checked, less what the camera shows without light, as far as that is known."""
    frame = checked_frame(frame, camera)
    if dark is not None:
        return subtract_dark(frame, dark, saturation_adu(camera))
    if camera.dark is not None:
        return subtract_dark_model(frame, camera.dark, exposure_s, saturation_adu(camera))
    return frame


def _saturated_facets(light: FacetLight, photometer: FacetPhotometer) -> str:
    """Which facets are saturated, the worst first, for a person; empty when none is."""
    share = light.saturated_share
    worst = [i for i in np.argsort(-share) if share[i] > MAX_SATURATED_SHARE]
    if not worst:
        return ""
    named = ", ".join(f"{photometer.facet_ids[i]} ({share[i]:.1%})" for i in worst[:N_NAMED_FACETS])
    more = f" and {len(worst) - N_NAMED_FACETS} more" if len(worst) > N_NAMED_FACETS else ""
    return f"saturated pixels on facets {named}{more} (limit {MAX_SATURATED_SHARE:.0%}): shorten the exposure"
