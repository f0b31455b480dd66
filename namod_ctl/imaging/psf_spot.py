"""The spot of a star on a screen or sensor in the focal plane: which light of a frame is its, and which is not.

A frame becomes an image of linear light without hot pixels; the brightest group of light in it is the spot. A spot
may consist of many pieces, one for every facet that is astray: pieces belong together when the gaps between them are
small against the size of the whole. Light beyond such a gap is another star's, or a ghost's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.dark import repair_pixels
from namod_ctl.imaging.radiometry import N_COLOURS, Frame, checked_frame, response_table, saturation_adu
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HOT_SIGMAS = 8.0
LOWER_CLIP, UPPER_CLIP = 4.0, 2.0
"""In standard deviations: what lies above a coarse background is likely light of a star."""
CLIP_STEPS = 10
N_BLOCKS = 32
"""Along the shorter edge of the image, of the coarse background."""

SMOOTHING_SHARE, LEAST_SMOOTHING_PX, MOST_SMOOTHING_PX = 0.008, 1.0, 8.0
"""Of the shorter edge: the gaussian's width with which faint light is made out."""
SMOOTHING_OF_SPOT = 0.3
"""That width for a spot that is seen to be sharp, in its own standard deviations along the short axis."""
FOUND_SIGMAS = 6.0
FOUND_SHARE = 0.004
"""Of the peak: a gaussian's edge at 3.3 standard deviations. Fainter light is left to the growth of the aperture."""
LEAST_DITHER_ADU = 0.35
"""Noise below does not hide the steps of whole numbers."""
GAP_RADII = 1.0
"""Gaps between the pieces of one spot, in root mean square radii of what belongs to it."""
MAX_OTHER_SHARE = 0.3
"""Of the spot's light: something brighter beside it is a second spot."""
LEAST_OTHER_SHARE = 0.002
"""Fainter light beside the spot is left out without a word."""
N_MASK_SIGMAS = 3.0
SAMPLE_STEP = 4
"""Of rows and columns that tell the noise of the sky."""


@dataclass(frozen=True, slots=True, eq=False)
class LightImage:
    """A frame as linear light.

    Attributes
    ----------
    light
        Shape (rows, columns). In units of a linear camera's ADU, dark level and background still in it where they make
        no difference; hot and dead pixels are repaired.
    is_saturated, is_zero
        Same shape: pixels that reach the saturation, and those whose response is 0, where noise may be cut off.
    peak_share
        Brightest pixel as a share of full scale.
    """

    light: Array
    is_saturated: Mask
    is_zero: Mask
    peak_share: float


@dataclass(frozen=True, slots=True)
class OtherLight:
    """Light beside the spot that is taken for something else: where, and how much of it in units of the spot's."""

    x_px: float
    y_px: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class SpotPlace:
    """Where the spot is, roughly.

    Attributes
    ----------
    centre_px
        Shape (2,), (x, y), of the light that was made out.
    covariance_px2
        Shape (2, 2).
    light
        All of it, roughly.
    spot_px
        Shape (n, 2), (x, y) of the pixels where it was made out.
    is_other
        Shape (rows, columns): pixels that other light falls on.
    others
        What that is.
    """

    centre_px: Array
    covariance_px2: Array
    light: float
    spot_px: Array
    is_other: Mask
    others: tuple[OtherLight, ...]


def light_image(frame: Frame, camera: CameraModel, exposure_s: float) -> LightImage:
    """The frame of `camera` as linear light.

    Raises
    ------
    ConfigError
        It is no frame of the camera.
    DataQualityError
        It is saturated almost all over.
    """
    frame = checked_frame(frame, camera)
    is_bad = _bad_pixels(frame)
    if camera.dark is not None and len(camera.dark.hot_pixels):
        is_bad[camera.dark.hot_pixels[:, 1], camera.dark.hot_pixels[:, 0]] = True
    is_colour = frame.ndim == N_COLOURS
    if is_bad.any():
        frame = repair_pixels(frame, np.repeat(is_bad[..., None], N_COLOURS, axis=2) if is_colour else is_bad)
    brightest = frame.max(axis=2) if is_colour else frame
    is_saturated = brightest >= saturation_adu(camera)
    if is_saturated.mean() > 0.5:
        raise DataQualityError("most of the image is saturated: expose shorter, and darken the screen's surroundings")
    level_adu = 0.0
    if camera.dark is not None:  # frames of other programs may not tell their exposures
        level_adu = camera.dark.level_adu(exposure_s if np.isfinite(exposure_s) else 0.0)
    if camera.law.r_resp == 1.0 and camera.law.r_curve == 0.0:
        light = frame.astype(np.float64)
    else:
        # below the dark level the law goes on as its own mirror image: noise that is cut off would shift the background
        table = camera.full_scale_adu * response_table(camera, frame.dtype)
        away = frame - level_adu
        light = np.sign(away) * np.interp(np.abs(away), np.arange(len(table)), table)
    return LightImage(
        light=light.mean(axis=2) if is_colour else light,
        is_saturated=is_saturated,
        is_zero=(frame == 0).any(axis=2) if is_colour else frame == 0,
        peak_share=float(brightest.max()) / camera.full_scale_adu,
    )


def find_spot(image: LightImage) -> SpotPlace:
    """The brightest spot of an image.

    Raises
    ------
    DataQualityError
        There is none, or several; it reaches the edge, or is saturated.
    """
    excess = image.light - coarse_background(image.light)
    width_px = float(np.clip(SMOOTHING_SHARE * min(excess.shape), LEAST_SMOOTHING_PX, MOST_SMOOTHING_PX))
    while True:
        smooth, groups = _pieces(excess, width_px)
        light_of = _light_of(groups, smooth)
        spot = _grown(groups, smooth, light_of)
        is_spot = np.isin(groups, list(spot))
        y, x = np.nonzero(is_spot)
        centre, covariance = _moments(x, y, smooth[is_spot])
        minor_px = float(np.sqrt(np.linalg.eigvalsh(covariance)[0]))
        sharp_px = max(SMOOTHING_OF_SPOT * float(np.sqrt(max(minor_px**2 - width_px**2, 0.0))), LEAST_SMOOTHING_PX)
        if width_px <= max(2.0 * sharp_px, LEAST_SMOOTHING_PX):
            break
        width_px = sharp_px  # the spot is sharp: it must not look larger than it is
    total = sum(light_of[label] for label in spot)
    reach_px = N_MASK_SIGMAS * minor_px
    others = []
    is_other = np.zeros(groups.shape, dtype=bool)
    for label in light_of.keys() - spot:
        of_it = groups == label
        is_other |= of_it
        if light_of[label] > LEAST_OTHER_SHARE * total:
            rows, columns = np.nonzero(of_it)
            place, _ = _moments(columns, rows, smooth[of_it])
            others.append(OtherLight(float(place[0]), float(place[1]), light_of[label] / total))
    others.sort(key=lambda other: -other.share)
    if others and others[0].share > MAX_OTHER_SHARE:
        raise DataQualityError(
            f"several spots: one at column {others[0].x_px:.0f}, row {others[0].y_px:.0f} has {others[0].share:.0%} of "
            f"the light of the one at column {centre[0]:.0f}, row {centre[1]:.0f}; bring a star into the field that "
            "stands alone"
        )
    if image.is_saturated[is_spot].any():
        raise DataQualityError(
            f"{np.count_nonzero(image.is_saturated & is_spot)} pixels of the spot are saturated; expose shorter"
        )
    if x.min() == 0 or y.min() == 0 or x.max() == groups.shape[1] - 1 or y.max() == groups.shape[0] - 1:
        raise DataQualityError("the spot reaches the edge of the image; bring the star to its middle")
    return SpotPlace(
        centre_px=centre,
        covariance_px2=covariance,
        light=total,
        spot_px=np.column_stack([x, y]).astype(np.float64),
        is_other=_dilated(is_other, reach_px),
        others=tuple(others),
    )


def coarse_background(light: Array) -> Array:
    """A surface of second order under all that shines in the image, same shape."""
    size = max(min(light.shape) // N_BLOCKS, 2)
    rows, columns = (length // size for length in light.shape)
    blocks = light[: rows * size, : columns * size].reshape(rows, size, columns, size)
    level = np.median(blocks, axis=(1, 3)).ravel()
    middle = (size - 1) / 2.0
    row, column = (index.ravel() for index in np.indices((rows, columns)))
    u, v = _centred(column * size + middle, light.shape[1]), _centred(row * size + middle, light.shape[0])
    terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
    is_used = np.ones(len(level), dtype=bool)
    for _ in range(CLIP_STEPS):
        coefficients = np.linalg.lstsq(terms[is_used], level[is_used], rcond=None)[0]
        residual = level - terms @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(residual[is_used]))), 1e-3)
        is_used = (residual > -LOWER_CLIP * spread) & (residual < UPPER_CLIP * spread)
    u = _centred(np.arange(light.shape[1]), light.shape[1])
    v = _centred(np.arange(light.shape[0]), light.shape[0])[:, None]
    constant, along, down, bent, mixed, hollow = coefficients
    surface: Array = (constant + along * u + bent * u * u) + v * (down + mixed * u) + hollow * v * v
    return surface


def noise_of(light: Array) -> float:
    """Standard deviation of a pixel of dark sky, of which the image has most; its smooth structure does not count."""
    few = slice(None, -1, SAMPLE_STEP), slice(1, None, SAMPLE_STEP)
    rough = 0.5 * (light[few[1], few[1]] - light[few[1], few[0]] - light[few[0], few[1]] + light[few[0], few[0]])
    spread = 1.4826 * float(np.median(np.abs(rough)))
    for _ in range(3):
        is_quiet = np.abs(rough) < 4.0 * max(spread, 1e-9)
        spread = float(np.sqrt(np.mean(rough[is_quiet] ** 2)))
    return spread


def roughness(light: Array) -> Array:
    """Differences of diagonal pairs, shape one less than `light`: with the noise of one pixel, and no smooth light."""
    rough: Array = 0.5 * (light[1:, 1:] - light[1:, :-1] - light[:-1, 1:] + light[:-1, :-1])
    return rough


def _bad_pixels(frame: Frame) -> Mask:
    """Pixels that shine, or fail to, as no light through a lens can; shape (rows, columns)."""
    is_bad = np.zeros(frame.shape[:2], dtype=bool)
    channels = [frame] if frame.ndim == 2 else [np.ascontiguousarray(frame[..., c]) for c in range(N_COLOURS)]
    for channel in channels:
        around = cv2.medianBlur(channel, 5).astype(np.float64)
        excess = channel - around
        # bright places have more noise, and a sharp spot stands above its surroundings
        noise = max(noise_of(channel.astype(np.float64)), 0.3)
        allowed = HOT_SIGMAS * noise + np.maximum(around - float(np.median(around)), 0.0)
        is_bad |= np.abs(excess) > allowed
    return is_bad


def _centred(place: NDArray[Any], length: int) -> Array:
    """Places of pixels along an edge of the image, from -1 to 1."""
    centred: Array = 2.0 * place / length - 1.0
    return centred


def _pieces(excess: Array, width_px: float) -> tuple[Array, NDArray[np.int32]]:
    """The light, smoothed, and pieces of the image that shine, numbered from 1. Raises DataQualityError for none."""
    smooth = np.asarray(cv2.GaussianBlur(excess.astype(np.float32), (0, 0), width_px), dtype=np.float64)
    # white noise, smoothed; what is left of an uneven sky counts as well
    noise = noise_of(excess)
    spread = noise / (2.0 * np.sqrt(np.pi) * width_px)
    quiet = smooth[np.abs(smooth) < 10.0 * spread]
    if quiet.size > smooth.size // 4:
        spread = max(spread, 1.4826 * float(np.median(np.abs(quiet))))
    threshold = max(FOUND_SIGMAS * spread, FOUND_SHARE * float(smooth.max()))
    if noise < LEAST_DITHER_ADU:  # a sky that rises from one whole number to the next shows a step
        threshold = max(threshold, 1.0)
    n, groups = cv2.connectedComponents((smooth > threshold).astype(np.uint8), connectivity=8)
    if n < 2:
        raise DataQualityError(
            f"no star in the image: nothing stands {FOUND_SIGMAS:g} sigma above the background; bring the star into "
            "the field, or expose longer"
        )
    return smooth, np.asarray(groups, dtype=np.int32)


def _light_of(groups: NDArray[np.int32], smooth: Array) -> dict[int, float]:
    """Light of every piece, by its number."""
    light = np.bincount(groups.ravel(), smooth.ravel())
    return {number: float(light[number]) for number in range(1, len(light))}


def _grown(groups: NDArray[np.int32], smooth: Array, light_of: dict[int, float]) -> set[int]:
    """Numbers of the pieces that belong to the brightest, by the gaps between them."""
    spot = {max(light_of, key=lambda label: light_of[label])}
    while True:
        is_spot = np.isin(groups, list(spot))
        y, x = np.nonzero(is_spot)
        _, covariance = _moments(x, y, smooth[is_spot])
        away = cv2.distanceTransform((~is_spot).astype(np.uint8), cv2.DIST_L2, 5)
        reach_px = GAP_RADII * float(np.sqrt(np.trace(covariance)))
        near = {int(label) for label in np.unique(groups[(away <= reach_px) & (groups > 0)])}
        if near <= spot:
            return spot
        spot |= near


def _moments(x: NDArray[np.intp], y: NDArray[np.intp], light: Array) -> tuple[Array, Array]:
    places = np.column_stack([x, y]).astype(np.float64)
    share = light / light.sum()
    mean = share @ places
    offset = places - mean
    return mean, np.einsum("n,na,nb->ab", share, offset, offset) + np.eye(2) / 12.0


def _dilated(mask: Mask, reach_px: float) -> Mask:
    if not mask.any():
        return mask
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    dilated: Mask = np.asarray(away <= reach_px)
    return dilated
