"""Responses of a lamp series put together by visits: successive frames of one exposure at one stand of the lamp."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.dark_level import rounding_bias_adu
from namod_ctl.calibration.lamp.lamp_series import PatchDark, Placement, Response

Array = NDArray[np.float64]

MAX_CLIPPED_SHARE = 1e-3
MAX_EMPTY_SHARE = 0.02
"""A frame counts when no more of the patch's pixels are saturated, or cut off at zero."""

MIN_LIGHT_ADU = 2.0
MIN_LIGHT_ERRORS = 20.0
"""Light counts from so many adu above the dark, and from so many times the uncertainty of the dark level."""

SAME_EXPOSURE = 1e-3
ODD_FRAME_SIGMAS = 6.0
MIN_FRAMES_FOR_ODD = 4
PRIOR_FRAMES = 10.0
"""Weight, in frames, of the flicker of all exposures together beside that of one exposure."""


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """Responses of successive frames of one exposure at one placement, put together; arrays of shape (n_visits,).

    Attributes
    ----------
    log_share
        log10 of the response above the dark as a share of full scale.
    lever_per_adu
        By how much an error of the dark level by 1 adu changes it.
    variance
        Of log_share, by the pixels' noise and the lamp's flicker as these frames show them.
    time
        Runs from -0.5 to 0.5 over the series.
    has_time
        The frames tell when they were taken; else their order stands for it.
    largest_share
        Response, as a share of full scale with the dark in it, of the brightest channel.
    flicker_share
        Standard deviation of the response from frame to frame beyond the pixels' noise.
    """

    names: tuple[str, ...]
    placement: NDArray[np.intp]
    log_level: Array
    log_exposure: Array
    log_share: Array
    lever_per_adu: Array
    variance: Array
    time: Array
    has_time: bool
    largest_share: Array
    is_usable: NDArray[np.bool_]
    is_clipped: NDArray[np.bool_]
    is_faint: NDArray[np.bool_]
    n_frames: NDArray[np.intp]
    n_odd_frames: int
    flicker_share: float

    @property
    def n(self) -> int:
        """Number of visits."""
        return len(self.names)


def visits_of(
    responses: Sequence[Response],
    placements: Sequence[Placement],
    dark: PatchDark,
    n_pixels: int,
    full_scale_adu: float,
    r_resp: float,
) -> Visits:
    """The responses put together by visits, in the order of time.

    Parameters
    ----------
    r_resp
        With which the channels of a colour frame are averaged: its intensity is the mean of its channels'.
    """
    has_time = all(math.isfinite(response.time_s) for response in responses)
    ordered = sorted(responses, key=lambda response: response.time_s) if has_time else list(responses)
    groups: list[list[Response]] = []
    for response in ordered:
        last = groups[-1][-1] if groups else None
        if (
            last
            and last.placement == response.placement
            and math.isclose(last.exposure_s, response.exposure_s, rel_tol=SAME_EXPOSURE)
        ):
            groups[-1].append(response)
        else:
            groups.append([response])
    floor_adu = max(MIN_LIGHT_ADU, MIN_LIGHT_ERRORS * dark.uncertainty_adu)
    raw = [_light(group, dark, n_pixels, full_scale_adu, r_resp) for group in groups]
    is_clipped = np.array([max(one.clipped_share for one in group) > MAX_CLIPPED_SHARE for group in groups])
    is_faint = np.array(
        [
            light.least_adu < floor_adu or max(one.empty_share for one in group) > MAX_EMPTY_SHARE
            for light, group in zip(raw, groups, strict=True)
        ]
    )
    exposures = np.array([group[0].exposure_s for group in groups])
    flicker, by_exposure = _flicker(raw, exposures, ~is_clipped & ~is_faint)
    middle = [float(np.mean([one.time_s for one in group])) for group in groups] if has_time else range(len(groups))
    time = np.array(middle, dtype=np.float64)
    span = float(np.ptp(time)) or 1.0
    kept = [_without_odd(light, by_exposure[round(math.log(t), 3)]) for light, t in zip(raw, exposures, strict=True)]
    n_kept = np.array([len(one) for one in kept])
    return Visits(
        names=tuple(PurePath(group[0].name).name for group in groups),
        placement=np.array([group[0].placement for group in groups], dtype=np.intp),
        log_level=np.log10([placements[group[0].placement].level for group in groups]),
        log_exposure=np.log10(exposures),
        log_share=np.array([float(np.mean(one)) for one in kept]),
        lever_per_adu=np.array([light.lever_per_adu for light in raw]),
        variance=np.array(
            [
                (light.pixel_variance + by_exposure[round(math.log(t), 3)]) / n + light.rounding_variance
                for light, t, n in zip(raw, exposures, n_kept, strict=True)
            ]
        ),
        time=(time - time.min()) / span - 0.5,
        has_time=has_time,
        largest_share=np.array([light.largest_adu for light in raw]) / full_scale_adu,
        is_usable=~is_clipped & ~is_faint,
        is_clipped=is_clipped,
        is_faint=is_faint,
        n_frames=np.array([len(group) for group in groups]),
        n_odd_frames=int(sum(len(light.log_share) - n for light, n in zip(raw, n_kept, strict=True))),
        flicker_share=flicker**0.5 * math.log(10.0),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Light:
    """Of one visit: log10 of the share frame by frame, its variance by pixel noise and by rounding, and levers."""

    log_share: Array
    pixel_variance: float
    rounding_variance: float
    lever_per_adu: float
    least_adu: float
    largest_adu: float


def _light(group: Sequence[Response], dark: PatchDark, n_pixels: int, full_scale_adu: float, r_resp: float) -> _Light:
    mean = np.array([one.mean_adu for one in group])
    noise = np.array([one.noise_adu for one in group]).mean(axis=0)
    light = np.maximum(mean - dark.level_adu(group[0].exposure_s), 1e-3)
    share = np.mean((light / full_scale_adu) ** r_resp, axis=1) ** (1.0 / r_resp)
    per_adu = 1.0 / (share.mean() * full_scale_adu * math.log(10.0))
    rounding = float(max(rounding_bias_adu(one) for one in noise))
    return _Light(
        log_share=np.log10(share),
        pixel_variance=float((noise**2).mean()) / n_pixels / len(noise) * per_adu**2,
        rounding_variance=0.5 * (rounding * per_adu) ** 2,  # of a sine of that height
        lever_per_adu=float(per_adu),
        least_adu=float(light.mean(axis=0).min()),
        largest_adu=float(mean.max()),
    )


def _flicker(
    raw: Sequence[_Light], exposures_s: Array, is_usable: NDArray[np.bool_]
) -> tuple[float, Mapping[float, float]]:
    """Variance of log10 of the response from frame to frame beyond the pixels' noise: of all, and by log exposure.

    Robust: from differences of successive frames. A lamp on mains flickers more in short exposures.
    """
    keys = [round(math.log(exposure_s), 3) for exposure_s in exposures_s]
    squares: dict[float, list[float]] = {key: [] for key in keys}
    for light, key, usable in zip(raw, keys, is_usable, strict=True):
        if usable and len(light.log_share) > 1:
            squares[key] += list(np.diff(light.log_share) ** 2 / 2.0 - light.pixel_variance)
    everyone = np.array([value for values in squares.values() for value in values])
    if not everyone.size:
        return 0.0, dict.fromkeys(squares, 0.0)
    limit = (
        12.0 * max(float(np.percentile(everyone, 75.0)), 0.0) + 1e-15
    )  # 4 sigma of differences; beyond are odd frames
    whole = max(float(everyone[everyone <= limit].mean()), 0.0)
    by_exposure = {}
    for key, values in squares.items():
        inside = [value for value in values if value <= max(limit, 12.0 * whole)]
        by_exposure[key] = max((sum(inside) + PRIOR_FRAMES * whole) / (len(inside) + PRIOR_FRAMES), 0.0)
    return whole, by_exposure


def _without_odd(light: _Light, flicker_variance: float) -> Array:
    """log10 of the shares without single frames far from the others of the visit."""
    values = light.log_share
    if len(values) < MIN_FRAMES_FOR_ODD:
        return values
    limit = ODD_FRAME_SIGMAS * max(light.pixel_variance + flicker_variance, 1e-12) ** 0.5
    kept: Array = values[np.abs(values - np.median(values)) <= limit]
    return kept if len(kept) * 2 > len(values) else values
