"""Which stars of the catalogue the stars of a frame may be: every answer that is worth a thought, and how good it is.

Triangles of the frame's brightest stars that look like triangles of the sky suggest how the camera may have looked.
Every suggestion is fitted as a plate, and the stars it explains are counted. Then it is worked out how many solutions
as good as this one chance alone would be expected to make in the whole search, from the number of ways to lay the frame
on the sky, the share of the frame that lies as close to a catalogue star as the matched stars do, and how well their
magnitudes follow the catalogue's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import binom

from namod_ctl.calibration.geometry.plate_solution import (
    K1_OF_TANGENT,
    K2_OF_TANGENT,
    LensPriors,
    Plate,
    PlateFit,
    fit_plate,
)
from namod_ctl.calibration.geometry.star_triangles import (
    SCALE_TOLERANCE,
    SHORTEST_SIDE_SHARE,
    STARS_PER_FIELD,
    Triangles,
    all_corners,
    attitudes,
    close_corners,
    look_alikes,
    triangles_of,
)
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.coordinates import direction_at_angles

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MIN_STARS = 4
"""Fewer leave nothing over that could contradict."""

N_TRIANGLE_STARS = 10
"""Brightest stars of the frame that triangles are made of."""

N_BRIGHT_STARS = 24
"""Brightest stars of the frame that a solution is judged by."""

FIRST_TOLERANCE_PX, FIRST_TOLERANCE_SHARE = 4.0, 0.012
"""How far a star may be from where a triangle says it is, and the share of its distance from the triangle."""

TOLERANCES_PX = (8.0, 4.0, 2.0)
"""How far from where the plate says, one fit after the other."""

N_LAST_FITS = 4
"""With the last tolerance, until the stars stay the same."""

DISTORTION_CELLS = 10.0
"""So many different bends of the lens can be told apart within the last tolerance: each is a try of its own."""

N_SHUFFLES = 2000
N_REFINED = 80
CHUNK = 4000
GOOD_ENOUGH = 1e-12
"""With a solution that chance makes so rarely, suggestions that explain fewer stars are not tried any more."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenStars:
    """Stars of a frame, brightest first.

    Attributes
    ----------
    pixel
        Shape (n, 2), (x, y).
    error_px
        Shape (n,), one standard deviation of each axis.
    magnitude
        Shape (n,), with any zero point.
    is_exact
        Shape (n,): False for saturated stars and those with a companion: recognized, but not measured.
    """

    pixel: Array
    error_px: Array
    magnitude: Array
    is_exact: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class KnownStars:
    """Stars of the catalogue that may be in the frame.

    Attributes
    ----------
    directions
        Shape (m, 3), unit vectors.
    magnitude, is_exact
        Shape (m,): in V, and good for measuring.
    number
        Shape (m,): index in the catalogue.
    """

    directions: Array
    magnitude: Array
    is_exact: NDArray[np.bool_]
    number: Indices


@dataclass(frozen=True, slots=True, eq=False)
class FieldMatch:
    """A frame recognized.

    Attributes
    ----------
    seen, known
        Shape (n_matched,): indices of stars of the frame and of `KnownStars` that are the same.
    fit
        Of those matched stars that `is_measured`, shape (n_matched,), says are exact in both.
    false_expected
        Number of solutions as good that chance makes in one search.
    missing
        Indices of known stars that should have been seen.
    strangers
        Indices of seen stars, as bright as the matched ones, that are none of the catalogue.
    magnitude_scatter
        Mean difference of the magnitudes, less their common zero point.
    """

    seen: Indices
    known: Indices
    is_measured: NDArray[np.bool_]
    fit: PlateFit
    false_expected: float
    missing: Indices
    strangers: Indices
    magnitude_scatter: float


class FieldSearch:
    """One frame, tried against the sky."""

    def __init__(self, seen: SeenStars, known: KnownStars, camera: CameraModel, priors: LensPriors) -> None:
        self._seen, self._known, self._camera, self._priors = seen, known, camera, priors
        self._tree = cKDTree(known.directions) if len(known.number) else None
        self._size_px = np.array([camera.n_columns, camera.n_rows], dtype=np.float64)
        self._diagonal_rad = camera.plate_scale_rad * float(np.hypot(*self._size_px))
        self._n_bright = min(len(seen.pixel), N_BRIGHT_STARS)
        self._rough = Plate(camera.plate_scale_rad, False, priors.centre_pixel, K1_OF_TANGENT, K2_OF_TANGENT, np.eye(3))
        self._ways = self._ways_to_lay_pairs()
        self._rng = np.random.default_rng(0)

    def solutions(self) -> list[FieldMatch]:
        """Everything that explains at least `MIN_STARS` stars."""
        if self._tree is None:
            return []
        found: dict[frozenset[tuple[int, int]], FieldMatch] = {}
        n_explained = 0
        for count, plate in self._suggestions():
            if count < n_explained:
                break
            match = self._refined(plate)
            if match is not None:
                found.setdefault(frozenset(zip(match.seen.tolist(), match.known.tolist(), strict=True)), match)
                if match.false_expected < GOOD_ENOUGH:
                    n_explained = max(n_explained, count)
        return list(found.values())

    def _suggestions(self) -> list[tuple[int, Plate]]:
        """How many stars it explains, and the plate, of triangles that look alike; most stars first."""
        angles = self._rough.angles_of(self._seen.pixel[: self._n_bright])
        vectors = direction_at_angles(angles)
        shortest_rad = SHORTEST_SIDE_SHARE * self._diagonal_rad
        of_frame = triangles_of(vectors, all_corners(min(self._n_bright, N_TRIANGLE_STARS)), shortest_rad)
        of_sky = self._triangles_of_sky(shortest_rad * (1.0 - SCALE_TOLERANCE))
        one, other = look_alikes(of_frame, of_sky)
        if one.size == 0:
            return []
        scale = np.exp(of_sky.log_longest[other] - of_frame.log_longest[one])
        is_mirrored = of_frame.is_left[one] != of_sky.is_left[other]
        counts, turns = [], []
        for first in range(0, one.size, CHUNK):
            part = slice(first, first + CHUNK)
            count, turn = self._counted(
                angles, scale[part], is_mirrored[part], of_frame.corners[one[part]], of_sky.corners[other[part]]
            )
            counts.append(count)
            turns.append(turn)
        count, turn = np.concatenate(counts), np.concatenate(turns)
        best = np.argsort(-count, kind="stable")[:N_REFINED]
        return [
            (
                int(count[i]),
                replace(
                    self._rough,
                    plate_scale_rad=self._rough.plate_scale_rad * float(scale[i]),
                    is_mirrored=bool(is_mirrored[i]),
                    attitude=turn[i],
                ),
            )
            for i in best
            if count[i] >= MIN_STARS
        ]

    def _triangles_of_sky(self, shortest_rad: float) -> Triangles:
        share_of_sky = float(np.prod(self._size_px)) * self._camera.plate_scale_rad**2 / (4.0 * math.pi)
        longest_rad = self._diagonal_rad * (1.0 + SCALE_TOLERANCE)
        return _triangles_among(self._known, int(STARS_PER_FIELD / share_of_sky), shortest_rad, longest_rad)

    def _counted(
        self, angles: Array, scale: Array, is_mirrored: NDArray[np.bool_], corners: Indices, known: Indices
    ) -> tuple[Indices, Array]:
        """How many bright stars each suggestion explains, shape (n,), and its attitude, shape (n, 3, 3)."""
        assert self._tree is not None
        signs = np.stack([np.where(is_mirrored, -1.0, 1.0), np.ones(scale.size)], axis=-1)
        all_angles = angles * (scale[:, None] * signs)[:, None, :]
        vectors = direction_at_angles(all_angles)
        rows = np.arange(scale.size)[:, None]
        turns = attitudes(vectors[rows, corners], self._known.directions[known])
        directions = vectors @ turns.transpose(0, 2, 1)
        from_triangle = np.linalg.norm(all_angles - all_angles[rows, corners].mean(axis=1, keepdims=True), axis=-1)
        tolerance = FIRST_TOLERANCE_PX * self._camera.plate_scale_rad + FIRST_TOLERANCE_SHARE * from_triangle
        distance, nearest = self._tree.query(directions, distance_upper_bound=float(tolerance.max()))
        is_hit = distance <= tolerance
        # A star of the sky that is hit twice counts once.
        nearest = np.sort(np.where(is_hit, nearest, -1), axis=1)
        count = (nearest[:, :1] >= 0).sum(axis=1) + ((np.diff(nearest, axis=1) > 0) & (nearest[:, 1:] >= 0)).sum(axis=1)
        return count, turns

    def _refined(self, plate: Plate) -> FieldMatch | None:
        """The plate fitted to all stars it explains, with ever closer limits; None when too few are left."""
        first_px = FIRST_TOLERANCE_PX + FIRST_TOLERANCE_SHARE * 0.5 * float(np.hypot(*self._size_px))
        last_px = TOLERANCES_PX[-1]
        fit: PlateFit | None = None
        fitted: Indices | None = None
        for tolerance_px in (first_px, *TOLERANCES_PX, *[last_px] * N_LAST_FITS):
            seen, known = self._pairs(plate, tolerance_px)
            is_exact = self._seen.is_exact[seen] & self._known.is_exact[known]
            if is_exact.sum() < MIN_STARS:
                return None
            if fit is not None and fitted is not None and np.array_equal(fitted, seen):
                return self._judged(seen, known, is_exact, fit) if fit.is_used.sum() >= MIN_STARS else None
            fit = fit_plate(
                self._seen.pixel[seen[is_exact]],
                self._seen.error_px[seen[is_exact]],
                self._known.directions[known[is_exact]],
                plate,
                self._priors,
                max_dropped=int(is_exact.sum()) // 4 if tolerance_px == last_px else 0,
            )
            plate, fitted = fit.plate, seen if tolerance_px == last_px else None
            if not 1.0 - SCALE_TOLERANCE < plate.plate_scale_rad / self._camera.plate_scale_rad < 1.0 + SCALE_TOLERANCE:
                return None
        return None

    def _pairs(self, plate: Plate, tolerance_px: float) -> tuple[Indices, Indices]:
        """Stars of the frame and of the sky that the plate brings together, one to one; doubtful ones are left out."""
        assert self._tree is not None
        directions = plate.directions_of(self._seen.pixel)
        tolerance_rad = tolerance_px * plate.plate_scale_rad
        nearby = self._tree.query_ball_point(directions, tolerance_rad)
        seen = np.array([i for i, some in enumerate(nearby) if len(some) == 1], dtype=np.int64)
        known = np.array([some[0] for some in nearby if len(some) == 1], dtype=np.int64)
        values, counts = np.unique(known, return_counts=True)
        is_single = np.isin(known, values[counts == 1])
        return seen[is_single], known[is_single]

    def _judged(self, seen: Indices, known: Indices, is_exact: NDArray[np.bool_], fit: PlateFit) -> FieldMatch:
        limit_px = TOLERANCES_PX[-1]
        inside = self._inside(fit.plate)
        share = min(1.0, inside.size * math.pi * limit_px**2 / float(np.prod(self._size_px)))
        is_matched = np.zeros(len(self._seen.pixel), dtype=np.bool_)
        is_matched[seen] = True
        expected = math.inf
        for rank in np.flatnonzero(is_matched[: self._n_bright]):
            n_matched = int(is_matched[: rank + 1].sum())
            if n_matched >= MIN_STARS:
                by_chance = float(binom.sf(n_matched - 3, rank + 1 - 2, share))
                expected = min(expected, self._ways[rank] * self._n_bright * by_chance)
        scatter, chance_of_magnitudes = self._magnitudes(seen, known)
        matched_magnitude = self._known.magnitude[known]
        faintest = float(np.quantile(matched_magnitude, 0.75))
        missing = np.setdiff1d(inside, known)
        missing = missing[self._known.magnitude[missing] < faintest]
        middle = float(np.median(self._seen.magnitude[seen]))
        strangers = np.flatnonzero(~is_matched & (self._seen.magnitude < middle))
        return FieldMatch(
            seen, known, is_exact, fit, expected * chance_of_magnitudes, missing, strangers.astype(np.int64), scatter
        )

    def _inside(self, plate: Plate) -> Indices:
        """Known stars that the plate puts into the image."""
        assert self._tree is not None
        middle = plate.directions_of((self._size_px - 1.0) / 2.0)
        near = np.array(self._tree.query_ball_point(middle, self._diagonal_rad), dtype=np.int64)
        pixel = plate.pixels_of(self._known.directions[near])
        is_inside = ((pixel > 0.0) & (pixel < self._size_px - 1.0)).all(axis=1)
        return near[is_inside]

    def _magnitudes(self, seen: Indices, known: Indices) -> tuple[float, float]:
        """Mean difference of magnitudes less the zero point, and the chance of one so small among strangers."""
        difference_of = self._seen.magnitude[seen], self._known.magnitude[known]
        scatter = _scatter(difference_of[0][None], difference_of[1][None])[0]
        shuffled = self._rng.permuted(np.tile(difference_of[1], (N_SHUFFLES, 1)), axis=1)
        n_as_good = int((_scatter(difference_of[0][None], shuffled) <= scatter + 1e-12).sum())
        return float(scatter), (1.0 + n_as_good) / (1.0 + N_SHUFFLES)

    def _ways_to_lay_pairs(self) -> Array:
        """For every rank: how many ways there are to lay two of so many bright stars on two of the sky, shape (n,)."""
        n, known = self._n_bright, self._known
        if len(known.number) < 2:
            return np.zeros(n)
        longest_rad = self._diagonal_rad * (1.0 + SCALE_TOLERANCE)
        pairs = cKDTree(known.directions).query_pairs(longest_rad, output_type="ndarray")
        of_sky = np.sort(np.linalg.norm(known.directions[pairs[:, 0]] - known.directions[pairs[:, 1]], axis=1))
        vectors = direction_at_angles(self._rough.angles_of(self._seen.pixel[:n]))
        i, j = np.triu_indices(n, 1)
        length = np.linalg.norm(vectors[i] - vectors[j], axis=1)
        within = np.searchsorted(of_sky, length * (1.0 + SCALE_TOLERANCE)) - np.searchsorted(
            of_sky, length * (1.0 - SCALE_TOLERANCE)
        )
        ways = np.zeros(n)
        np.add.at(ways, j, 4.0 * DISTORTION_CELLS * np.maximum(within, 1))  # either way round, mirrored or not
        return np.cumsum(ways)


@lru_cache(maxsize=1)
def _triangles_among(known: KnownStars, n_brightest: int, shortest_rad: float, longest_rad: float) -> Triangles:
    """Triangles of the brightest stars: a second of work, which several frames under the same sky need once."""
    chosen = np.argsort(known.magnitude, kind="stable")[:n_brightest]
    corners = close_corners(known.directions[chosen], longest_rad)
    return triangles_of(known.directions, chosen[corners], shortest_rad)


def _scatter(one: Array, other: Array) -> Array:
    """Mean distance of the differences (..., n) from their median, shape (...)."""
    difference = one - other
    scatter: Array = np.abs(difference - np.median(difference, axis=-1, keepdims=True)).mean(axis=-1)
    return scatter
