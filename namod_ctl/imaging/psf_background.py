"""The background under a spot in the focal plane, from a ring around it, with all that is not known of it.

Second moments weigh light with the square of its distance from the spot's centre, so a level that is wrong by a
thousandth of the peak makes A_sigma wrong by per cents. The background is a surface of second order (sky, its
gradient, the vignetting of a screen), fitted to the ring together with the outer wings of the spot itself, whose
shape is told by the outer light of the spot (`psf_aperture`), their height to some share. What the ring shows beyond
the noise of its pixels makes the covariance of the fit larger, by its scatter between `N_SECTORS` x `N_RINGS` pieces
of the ring: structures in the sky are larger than pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import norm

from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.dark import QUANTISATION_NOISE_ADU

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Places = NDArray[Any]
"""Columns or rows, whole or not."""

N_TERMS = 6
"""Of the surface: 1, u, v, u^2, u v, v^2 of the distances from the centre in units of the ring's inner radius."""
WINGS = N_TERMS
"""Place of the wings' height among all coefficients, in units of the gaussian's own."""
FROM_K, RING_STEP_K = 2.0, 0.25
"""Where the wings begin, in standard deviations of the light, and the width of the rings that tell of them."""

BLOCKS_PER_RADIUS = 20
N_SECTORS, N_RINGS = 12, 2
MIN_SECTORS = 9
"""That must show sky: a surface that is known on one side only is not known under the spot."""
MIN_BLOCKS = 40
CLIP_SIGMAS, CLIP_STEPS = 4.0, 4
MIN_BLOCK_SHARE = 0.5
"""Of a block's pixels that must show sky for it to count."""
ZERO_SHARE = 0.005
"""With more of the sky's pixels at 0 the noise is cut off there, and the mean shifts."""

_TOO_LITTLE_SKY = (
    "too little sky around the spot to know the background under it; bring the star to the middle of the image, or "
    "take a camera with a larger field"
)


@dataclass(frozen=True, slots=True, eq=False)
class Wings:
    """The spot as far as its wings go.

    Its light per pixel at k standard deviations from the centre, `FROM_K` or more, is
    exp(log_light - slope (k - FROM_K) - bend (k - FROM_K)^2); a gaussian has the slope FROM_K and the bend 1/2.

    Attributes
    ----------
    centre_px, covariance_px2
        Shape (2,), (x, y), and (2, 2), of the spot; the wings' ellipses are those of `shape_px2`.
    relative_uncertainty
        Of the light that they hold far out, beyond what the noise of the rings makes of it.
    rise_per_level
        By how much that light rises, relative, with the mean light per pixel of each of the rings of `RING_STEP_K` from
        `FROM_K` outwards; empty for wings that no ring told of.
    """

    centre_px: Array
    covariance_px2: Array
    shape_px2: Array
    log_light: float
    slope: float
    bend: float
    relative_uncertainty: float
    rise_per_level: tuple[float, ...] = ()

    def at(self, k: Array) -> Array:
        """Light per pixel at these radii."""
        beyond = k - FROM_K
        light: Array = np.exp(self.log_light - self.slope * beyond - self.bend * beyond**2)
        return light


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The surface under the spot, and the height of its wings.

    Attributes
    ----------
    coefficients
        Shape (7,): of the surface's terms, then of the wings.
    covariance
        Shape (7, 7). By the noise of the pixels (and what is known of the wings beforehand).
    misfit_covariance
        Shape (7, 7). To be added: by what is no such surface, and by what rounding and a cut at 0 may hide. It is the
        same in all frames of one sky.
    noise
        Standard deviation of one pixel.
    zero_share
        Pixels of the ring whose response is 0.
    misfit
        Scatter of the ring's pieces in units of what their noise explains.
    """

    centre_px: Array
    scale_px: float
    coefficients: Array
    covariance: Array
    misfit_covariance: Array
    noise: float
    zero_share: float
    misfit: float

    def terms(self, x: Places, y: Places) -> Array:
        """Values of the surface's terms at pixels (...); shape (..., 6)."""
        return _terms(x, y, self.centre_px, self.scale_px)

    def surface(self, x: Places, y: Places) -> Array:
        """The background at pixels (...)."""
        level: Array = self.terms(x, y) @ self.coefficients[:N_TERMS]
        return level


def fit_background(
    light: Array,
    is_sky: Mask,
    is_zero: Mask,
    wings: Wings,
    ring_k: tuple[float, float],
    noise: float,
) -> Background:
    """The background of the ring around the spot between two of the wings' ellipses.

    Parameters
    ----------
    light, is_sky, is_zero
        Shape (rows, columns). The image, pixels that no other light falls on, and those that are 0.
    ring_k
        Radii of its inner and outer edge, in standard deviations.
    noise
        Standard deviation of a pixel, from the roughness of the image.

    Raises
    ------
    DataQualityError
        The ring shows too little sky.
    """
    inner_px, outer_px = (k * float(np.sqrt(np.linalg.eigvalsh(wings.shape_px2)[1])) for k in ring_k)
    blocks = _blocks(light, is_sky, is_zero, wings, ring_k, outer_px, max(int(inner_px / BLOCKS_PER_RADIUS), 1))
    k = radius_in_sigmas(blocks.x, blocks.y, wings.centre_px, wings.shape_px2)
    terms = np.column_stack([_terms(blocks.x, blocks.y, wings.centre_px, inner_px), wings.at(k)])
    coefficients, covariance, kept = _solved(terms, blocks, noise, wings.relative_uncertainty)
    angle = np.arctan2(blocks.y - wings.centre_px[1], blocks.x - wings.centre_px[0])
    sector = ((angle + np.pi) / (2.0 * np.pi) * N_SECTORS).astype(int) % N_SECTORS
    if len(np.unique(sector[kept])) < MIN_SECTORS:
        raise DataQualityError(_TOO_LITTLE_SKY)
    middle_k = np.sqrt((ring_k[0] ** 2 + ring_k[1] ** 2) / 2.0)
    residual = blocks.level - terms @ coefficients
    misfit2 = max(_scatter2(residual, blocks.n, noise, sector + N_SECTORS * (k > middle_k), kept), 1.0)
    hidden = _hidden_level(noise, blocks.zero_share)
    level_only = np.zeros((N_TERMS + 1, N_TERMS + 1))
    level_only[0, 0] = hidden**2
    return Background(
        centre_px=wings.centre_px,
        scale_px=inner_px,
        coefficients=coefficients,
        covariance=covariance,
        misfit_covariance=(misfit2 - 1.0) * covariance + level_only,
        noise=noise,
        zero_share=blocks.zero_share,
        misfit=float(np.sqrt(misfit2)),
    )


def radius_in_sigmas(x: Places, y: Places, centre_px: Array, covariance_px2: Array) -> Array:
    """Distances of pixels (...) from the centre in standard deviations of that covariance."""
    offset = np.stack([x - centre_px[0], y - centre_px[1]], axis=-1)
    squared = np.einsum("...a,ab,...b->...", offset, np.linalg.inv(covariance_px2), offset)
    radius: Array = np.sqrt(squared)
    return radius


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """Means over small squares of the ring, shape (n,): places, pixels of sky, their mean level; share that is 0."""

    x: Array
    y: Array
    n: Array
    level: Array
    zero_share: float


def _terms(x: Places, y: Places, centre_px: Array, scale_px: float) -> Array:
    u, v = (x - centre_px[0]) / scale_px, (y - centre_px[1]) / scale_px
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _blocks(
    light: Array, is_sky: Mask, is_zero: Mask, wings: Wings, ring_k: tuple[float, float], reach_px: float, size: int
) -> _Blocks:
    """The image around the spot in squares of `size` pixels; those whose middle is in the ring."""
    windows = []
    for centre, length in zip(wings.centre_px[::-1], light.shape, strict=True):
        first = max(int(np.floor(centre - reach_px)), 0)
        last = min(int(np.ceil(centre + reach_px)) + 1, length)
        windows.append(slice(first, first + (last - first) // size * size))
    rows, columns = windows

    def summed(values: NDArray[Any]) -> Array:
        cut = values[rows, columns].astype(np.float64)
        total: Array = cut.reshape(cut.shape[0] // size, size, cut.shape[1] // size, size).sum(axis=(1, 3))
        return total

    n = summed(is_sky)
    index = size * np.indices(n.shape).astype(np.float64) + (size - 1) / 2.0
    x, y = columns.start + index[1], rows.start + index[0]
    k = radius_in_sigmas(x, y, wings.centre_px, wings.shape_px2)
    is_used = (k >= ring_k[0]) & (k <= ring_k[1]) & (n >= MIN_BLOCK_SHARE * size**2)
    count = n[is_used]
    n_zero = float(summed(is_zero & is_sky)[is_used].sum())
    level = summed(light * is_sky)[is_used] / count
    return _Blocks(x[is_used], y[is_used], count, level, n_zero / max(float(count.sum()), 1.0))


def _solved(terms: Array, blocks: _Blocks, noise: float, wings_uncertainty: float) -> tuple[Array, Array, Mask]:
    """Coefficients, their covariance by the noise, and the blocks that agree with them."""
    kept: Mask = np.ones(len(blocks.level), dtype=bool)
    for _ in range(CLIP_STEPS):
        if np.count_nonzero(kept) < MIN_BLOCKS:
            raise DataQualityError(_TOO_LITTLE_SKY)
        weight = blocks.n * kept / noise**2
        normal = terms.T @ (weight[:, None] * terms)
        right = terms.T @ (weight * blocks.level)
        normal[WINGS, WINGS] += 1.0 / wings_uncertainty**2
        right[WINGS] += 1.0 / wings_uncertainty**2
        covariance: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        coefficients = covariance @ right
        off = np.sqrt(blocks.n) * (blocks.level - terms @ coefficients)
        spread = max(1.4826 * float(np.median(np.abs(off[kept]))), noise)
        kept = np.abs(off) < CLIP_SIGMAS * spread
    return coefficients, covariance, kept


def _scatter2(residual: Array, n: Array, noise: float, piece: NDArray[np.intp], kept: Mask) -> float:
    """Square of the scatter of the pieces' means in units of their noise."""
    count = np.bincount(piece[kept], n[kept], N_SECTORS * N_RINGS)
    total = np.bincount(piece[kept], (n * residual)[kept], N_SECTORS * N_RINGS)
    seen = count > 0
    free = np.count_nonzero(seen) - N_TERMS
    if free < 1:
        raise DataQualityError(_TOO_LITTLE_SKY)
    return float(np.sum(total[seen] ** 2 / count[seen]) / noise**2 / free)


def _hidden_level(noise: float, zero_share: float) -> float:
    """What the background's level may be wrong by against the light under the spot, which noise lifts above.

    Rounding shifts means that noise does not carry over several steps, by exp(-2 pi^2 sigma^2) / pi of a step at most
    (the first term of its Fourier series); a cut at 0 shifts the mean of normal noise.
    """
    analogue2 = max(noise**2 - QUANTISATION_NOISE_ADU**2, 0.0)
    rounding = float(np.exp(-2.0 * np.pi**2 * analogue2) / np.pi)
    if zero_share <= ZERO_SHARE:
        return rounding
    edge = -float(ndtri(min(zero_share, 0.99)))
    return float(np.hypot(rounding, noise * (norm.pdf(edge) - edge * zero_share)))
