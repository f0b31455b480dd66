"""What a camera shows without light: bias, dark current, noise, fixed pattern and hot pixels, from dark frames.

Frames with light in them are refused: a calibration that takes light for the camera's own would darken every star.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.dark_level import DarkLevel, dark_level
from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.dark import HOT_SIGMAS, QUANTISATION_NOISE_ADU

Array = NDArray[np.float64]
Image = NDArray[np.unsignedinteger[Any]]

MIN_FRAMES = 3
MIN_EXPOSURE_RATIO = 3.0
"""Between the longest and the shortest exposure: with less, a rate of dark current is noise."""

MAX_LEVEL_SHARE = 0.5
MAX_GROWTH_SHARE = 0.1
"""Of full scale: no sensor that is good for stars fills that much of itself without light in seconds."""

MAX_HOT_SHARE = 0.01
BLOCK_PX = 32
BLOCK_SIGMAS = 8.0
MIN_STRUCTURE_ADU = 1.0
"""Broad structure in dark frames below this is the sensor's own glow, and does no harm."""

MIN_HOT_ADU = 3.0
"""A pixel that shows less above the others at the longest exposure does no harm, however surely it is seen."""

SIBLING_SIGMAS = 8.0
MIN_SIBLING_SHARE = 0.002
MIN_BLOB_PX = 9
"""Bright pixels that hang together, so many in every frame, are an image of something; hot pixels stand alone."""


@dataclass(frozen=True, slots=True, eq=False)
class DarkFrame:
    """One frame taken with the cap on: shape (rows, columns) or (rows, columns, 3), and its file or number."""

    name: str
    image: Image
    exposure_s: float


@dataclass(frozen=True, slots=True, eq=False)
class DarkCamera:
    """What a camera shows without light: `bias_adu` + `rate_adu_per_s` T, and pixels with more of their own.

    Attributes
    ----------
    read_noise_adu
        Standard deviation of a pixel from frame to frame at the shortest exposure.
    fixed_pattern_adu
        Standard deviation over ordinary pixels of what does not change from frame to frame.
    hot_xy
        Shape (n_hot, 2), int, (x, y).
    hot_offset_adu, hot_rate_adu_per_s
        Shape (n_hot,): their level at exposure T stands offset + rate T above the others'.
    has_rate
        The exposures reach far enough apart to tell rates; else these are 0 and everything is in the offsets.
    is_cut
        The floor at zero cuts the noise; is_lost: it leaves nothing.
    """

    bias_adu: float
    bias_uncertainty_adu: float
    rate_adu_per_s: float
    rate_uncertainty_adu_per_s: float
    read_noise_adu: float
    fixed_pattern_adu: float
    hot_xy: NDArray[np.int64]
    hot_offset_adu: Array
    hot_rate_adu_per_s: Array
    exposures_s: tuple[float, ...]
    n_frames: int
    n_cosmic_rays: int
    has_rate: bool
    is_cut: bool
    is_lost: bool


def measure_dark_frames(frames: Sequence[DarkFrame], full_scale_adu: float) -> DarkCamera:
    """What the camera shows without light.

    Raises
    ------
    DataQualityError
        Too few frames, frames of several kinds, or light in them; the frames are named.
    """
    _refuse_unlike(frames)
    exposures = sorted({round(frame.exposure_s, 9) for frame in frames})
    groups = [[frame for frame in frames if round(frame.exposure_s, 9) == exposure_s] for exposure_s in exposures]
    _refuse_bright(groups, full_scale_adu)
    cleaned = [_mean_without_cosmic_rays(np.stack([_grey(frame.image) for frame in group])) for group in groups]
    means, n_cosmic = [mean for mean, _ in cleaned], sum(n for _, n in cleaned)
    levels = [_level(group) for group in groups]
    noise = _read_noise(groups, levels[0])
    _refuse_structure(means, groups, noise, full_scale_adu)
    has_rate = exposures[-1] >= MIN_EXPOSURE_RATIO * exposures[0]
    bias, rate, cov = _line(np.array(exposures), levels, has_rate=has_rate)
    growth_adu = rate * exposures[-1]
    if growth_adu > MAX_GROWTH_SHARE * full_scale_adu:
        raise DataQualityError(
            f"the dark frames grow by {rate:.3g} adu per second to {levels[-1].level_adu:.3g} adu: light gets in, or "
            f"the sensor is very hot (limit {MAX_GROWTH_SHARE:.0%} of full scale); close the cap, darken the room, "
            "cool down"
        )
    is_hot, excess = _hot(means, groups, noise)
    xy = np.argwhere(is_hot)[:, ::-1].astype(np.int64)
    offset, hot_rate = _hot_lines(np.array(exposures), excess, is_hot, means, full_scale_adu, has_rate=has_rate)
    return DarkCamera(
        bias_adu=bias,
        bias_uncertainty_adu=float(cov[0, 0] ** 0.5),
        rate_adu_per_s=rate,
        rate_uncertainty_adu_per_s=float(cov[1, 1] ** 0.5),
        read_noise_adu=noise,
        fixed_pattern_adu=_fixed_pattern(excess[0], is_hot, noise, len(groups[0])),
        hot_xy=xy,
        hot_offset_adu=offset,
        hot_rate_adu_per_s=hot_rate,
        exposures_s=tuple(exposures),
        n_frames=len(frames),
        n_cosmic_rays=n_cosmic,
        has_rate=has_rate,
        is_cut=any(bool((frame.image == 0).mean() > 1e-3) for frame in groups[0]),
        is_lost=levels[0].is_lost,
    )


def refuse_light(frames: Sequence[DarkFrame], full_scale_adu: float) -> None:
    """Raise DataQualityError when frames that are called dark show light; fewer than `MIN_FRAMES` cannot tell."""
    if len(frames) >= MIN_FRAMES:
        measure_dark_frames(frames, full_scale_adu)


def _grey(image: Image) -> Image:
    """One response per pixel: of a colour frame that of its brightest channel, so that no hot one is missed."""
    return image if image.ndim == 2 else image.max(axis=2)


def _names(frames: Sequence[DarkFrame]) -> str:
    some = ", ".join(PurePath(frame.name).name for frame in frames[:4])
    return some + (f" and {len(frames) - 4} more" if len(frames) > 4 else "")


def _refuse_unlike(frames: Sequence[DarkFrame]) -> None:
    if len(frames) < MIN_FRAMES:
        raise DataQualityError(
            f"{len(frames)} dark frames are too few; take at least {MIN_FRAMES}, better 5 at each of several exposures"
        )
    kinds = {(frame.image.shape, frame.image.dtype.name): frame.name for frame in frames}
    if len(kinds) > 1:
        told = "; ".join(
            f"{PurePath(name).name}: {kind[0]}, {kind[1]}" for kind, name in sorted(kinds.items(), key=str)
        )
        raise DataQualityError(f"the dark frames are of several cameras or modes ({told}); give those of one")


def _refuse_bright(groups: Sequence[Sequence[DarkFrame]], full_scale_adu: float) -> None:
    """Frames that are bright in themselves, or brighter than others of the same exposure."""
    everyone = [frame for group in groups for frame in group]
    bright = [frame for frame in everyone if np.median(frame.image) > MAX_LEVEL_SHARE * full_scale_adu]
    if bright:
        raise DataQualityError(
            f"{_names(bright)}: half of the pixels show more than {MAX_LEVEL_SHARE:.0%} of full scale; these are no "
            "dark frames: put the cap on, or take them out"
        )
    for group in groups:
        if len(group) < MIN_FRAMES:
            continue
        means = np.array([_trimmed_mean(frame.image) for frame in group])
        middle = float(np.median(means))
        scatter = 1.4826 * float(np.median(np.abs(means - middle)))
        limit = max(SIBLING_SIGMAS * scatter, MIN_SIBLING_SHARE * full_scale_adu)
        odd = [frame for frame, mean in zip(group, means, strict=True) if abs(mean - middle) > limit]
        if odd:
            raise DataQualityError(
                f"{_names(odd)}: other than the other frames of {group[0].exposure_s:g} s ({max(means):.2f} against "
                f"{middle:.2f} adu): light got in, or the exposure is another; take new ones, or take it out"
            )


def _trimmed_mean(image: Image) -> float:
    """Mean without the brightest hundredth, where hot pixels and cosmic rays are."""
    counts = np.bincount(image.ravel())
    last = int(np.searchsorted(np.cumsum(counts), (1.0 - MAX_HOT_SHARE) * image.size))
    counts = counts[: last + 1]
    return float(np.average(np.arange(len(counts)), weights=counts))


def _mean_without_cosmic_rays(stack: Image) -> tuple[NDArray[np.float32], int]:
    """Mean of frames of one exposure (n, rows, columns), and how many pixels were hit by what others do not show."""
    n = len(stack)
    total = stack.sum(axis=0, dtype=np.float32)
    if n < 2:
        return total, 0
    brightest = stack.max(axis=0).astype(np.float32)
    rest = (total - brightest) / (n - 1)
    # Noise of the pixel by its own response: hot ones flicker as their dark current does.
    noise = 1.0 + np.sqrt(np.maximum(rest, 0.0))
    is_hit = brightest - rest > HOT_SIGMAS * noise
    mean = np.where(is_hit, rest, total / n).astype(np.float32)
    return mean, int(is_hit.sum())


def _level(group: Sequence[DarkFrame]) -> DarkLevel:
    """Level of the ordinary pixels of frames of one exposure; what frames differ by enters its uncertainty."""
    each = [dark_level(frame.image) for frame in group]
    values = np.array([level.level_adu for level in each])
    scatter = float(values.std(ddof=1)) / len(each) ** 0.5 if len(each) > 1 else 0.0
    error = float(np.hypot(scatter, np.mean([level.uncertainty_adu for level in each])))
    noise = float(np.mean([level.noise_adu for level in each]))
    return DarkLevel(float(values.mean()), noise, error, any(level.is_lost for level in each))


def _read_noise(groups: Sequence[Sequence[DarkFrame]], level: DarkLevel) -> float:
    """Noise from frame to frame at the shortest exposure that has two frames; where zero cuts it, that of `level`."""
    for group in groups:
        if len(group) < 2:
            continue
        first, second = (group[i].image for i in (0, 1))
        if (first == 0).mean() > 1e-3:
            return level.noise_adu
        difference = first.astype(np.float32) - second.astype(np.float32)
        spread = float(np.percentile(np.abs(difference), 99.0))  # cuts hot pixels and cosmic rays off
        inside = difference[np.abs(difference) <= 2.0 * spread + 1.0]
        variance = float(np.mean(inside**2)) / 2.0 - QUANTISATION_NOISE_ADU**2
        return float(max(variance, 0.0) ** 0.5)
    return level.noise_adu


def _line(exposures_s: Array, levels: Sequence[DarkLevel], *, has_rate: bool) -> tuple[float, float, Array]:
    """Bias and rate of the levels, weighted by their uncertainties, with covariance (2, 2)."""
    level = np.array([one.level_adu for one in levels])
    error = np.array([one.uncertainty_adu for one in levels])
    columns = [np.ones_like(exposures_s)] + ([exposures_s] if has_rate else [])
    design = np.stack(columns, axis=1) / error[:, None]
    cov_found = np.linalg.inv(design.T @ design)
    found = cov_found @ design.T @ (level / error)
    cov = np.zeros((2, 2))
    cov[: len(found), : len(found)] = cov_found
    return float(found[0]), float(found[1]) if has_rate else 0.0, cov


def _refuse_structure(
    means: Sequence[NDArray[np.float32]], groups: Sequence[Sequence[DarkFrame]], noise_adu: float, full_scale_adu: float
) -> None:
    """Light that falls on part of the sensor: blocks that stand above the others, or bright spots of many pixels."""
    longest, group = means[-1], groups[-1]
    blocks = _block_medians(longest)
    if blocks.size >= 4:
        middle = float(np.median(blocks))
        block_noise = max(
            1.4826 * float(np.median(np.abs(blocks - middle))), noise_adu / (BLOCK_PX * len(group) ** 0.5)
        )
        excess = float(blocks.max()) - middle
        limit = max(BLOCK_SIGMAS * block_noise, MIN_STRUCTURE_ADU, 0.01 * full_scale_adu)
        if excess > limit:
            row, column = np.argwhere(blocks == blocks.max())[0]
            raise DataQualityError(
                f"{_names(group)}: around column {int((column + 0.5) * BLOCK_PX)}, row {int((row + 0.5) * BLOCK_PX)} "
                f"they are {excess:.2g} adu brighter than elsewhere (limit {limit:.2g}): light falls on part of the "
                "sensor; put the cap on and darken the room"
            )
    is_bright = (longest - float(np.median(longest)) > max(HOT_SIGMAS * noise_adu, MIN_HOT_ADU)).astype(np.uint8)
    for mean in means[:-1]:  # light is in all of them, cosmic rays are in one
        if len(group) == 1:
            is_bright &= (mean - float(np.median(mean)) > MIN_HOT_ADU).astype(np.uint8)
    _, _, statistics, centres = cv2.connectedComponentsWithStats(is_bright, connectivity=8)
    blobs = np.flatnonzero(statistics[1:, cv2.CC_STAT_AREA] >= MIN_BLOB_PX) + 1
    if blobs.size:
        x, y = centres[blobs[0]]
        raise DataQualityError(
            f"{_names(group)}: {blobs.size} bright spots of many pixels, the first at column {x:.0f}, row {y:.0f}: "
            "these frames show stars or lights; put the cap on"
        )


def _block_medians(image: NDArray[np.float32]) -> Array:
    rows, columns = (size // BLOCK_PX * BLOCK_PX for size in image.shape)
    if not rows or not columns:
        return np.zeros(0)
    blocks = image[:rows, :columns].reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    means = np.sort(blocks.transpose(0, 2, 1, 3).reshape(rows // BLOCK_PX, columns // BLOCK_PX, -1), axis=2)
    quarter = means.shape[2] // 4  # of coarsely rounded pixels a trimmed mean tells more than a median
    trimmed: Array = means[:, :, quarter:-quarter].mean(axis=2, dtype=np.float64)
    return trimmed


def _hot(
    means: Sequence[NDArray[np.float32]], groups: Sequence[Sequence[DarkFrame]], noise_adu: float
) -> tuple[NDArray[np.bool_], list[NDArray[np.float32]]]:
    """Which pixels are hot, and what all pixels have above the others at every exposure."""
    levels = [_trimmed_level(mean) for mean in means]
    excess = [mean - np.float32(level) for mean, level in zip(means, levels, strict=True)]
    n_frames = [len(group) for group in groups]
    is_hot = np.zeros(means[0].shape, dtype=bool)
    for mean, level, group in zip(excess, levels, groups, strict=True):
        if len(group) < 2:
            continue  # in one frame alone a cosmic ray cannot be told from a hot pixel
        spread = 1.4826 * float(np.median(np.abs(mean)))
        sigma = max(spread, float(np.hypot(noise_adu, QUANTISATION_NOISE_ADU)) / len(group) ** 0.5)
        limit = max(HOT_SIGMAS * sigma, MIN_HOT_ADU)
        here = np.nonzero(mean > limit)
        shown = np.stack([_grey(frame.image)[here] for frame in group])
        # cosmic rays may hit a pixel twice, but never half of the frames
        is_hot[here] |= np.median(shown, axis=0) > level + 0.5 * limit
    if max(n_frames) < 2:
        is_hot = np.min(excess[-2:], axis=0) > max(HOT_SIGMAS * noise_adu, MIN_HOT_ADU)
    share = float(is_hot.mean())
    if share > MAX_HOT_SHARE:
        raise DataQualityError(
            f"{share:.1%} of the pixels stand out of the dark frames (limit {MAX_HOT_SHARE:.0%}): light gets in, or "
            "the sensor is damaged; close the cap and darken the room, then look at a frame"
        )
    return is_hot, excess


def _trimmed_level(mean: NDArray[np.float32]) -> float:
    low, high = np.percentile(mean, (5.0, 95.0))
    return float(mean[(mean >= low) & (mean <= high)].mean())


def _hot_lines(
    exposures_s: Array,
    excess: Sequence[NDArray[np.float32]],
    is_hot: NDArray[np.bool_],
    means: Sequence[NDArray[np.float32]],
    full_scale_adu: float,
    *,
    has_rate: bool,
) -> tuple[Array, Array]:
    """Offset and rate of every hot pixel, shape (n_hot,) each; saturated responses are left out."""
    above = np.stack([one[is_hot] for one in excess], axis=1).astype(np.float64)
    is_good = np.stack([mean[is_hot] for mean in means], axis=1) < 0.98 * full_scale_adu
    is_good[:, 0] |= ~is_good.any(axis=1)  # a pixel that is always saturated
    weight = is_good.astype(np.float64)
    n = weight.sum(axis=1)
    mean_t, mean_above = (weight @ exposures_s) / n, (weight * above).sum(axis=1) / n
    if not has_rate:
        return mean_above, np.zeros_like(mean_above)
    around_t = exposures_s[None, :] - mean_t[:, None]
    spread = (weight * around_t**2).sum(axis=1)
    slope = np.divide((weight * around_t * above).sum(axis=1), spread, out=np.zeros_like(mean_t), where=spread > 0.0)
    return mean_above - slope * mean_t, slope


def _fixed_pattern(excess: NDArray[np.float32], is_hot: NDArray[np.bool_], noise_adu: float, n_frames: int) -> float:
    ordinary = excess[~is_hot]
    temporal = (noise_adu**2 + QUANTISATION_NOISE_ADU**2) / n_frames
    return float(max(float(ordinary.var(dtype=np.float64)) - temporal, 0.0) ** 0.5)
