"""Which triangles of stars in a frame look like which triangles of the sky.

A triangle is known by its longest side and the ratios of its other two sides to that, and mirrored or not by the way
its corners follow each other. Corners are in the order of the sides that lie opposite to them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SCALE_TOLERANCE = 0.1
"""The config's plate scale may be so far off, relative."""

RATIO_TOLERANCE = 0.02
"""Of ratios of sides: what 1.5 % of distortion at the corner of an image does to stars there."""

SHORTEST_SIDE_SHARE = 0.05
"""Of the diagonal of the image: shorter sides say little."""

FLATTEST = 0.03
"""Twice the area over the square of the longest side: the corners of flatter triangles have no clear order around."""

STARS_PER_FIELD = 12.0
"""Mean number of catalogue stars in a field that triangles are made of; of wide fields the brighter ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """Triangles of unit vectors.

    Attributes
    ----------
    corners
        Shape (n, 3): indices of the corners, opposite to the longest, middle and shortest side.
    log_longest
        Shape (n,): natural logarithm of the longest side, rad (chord).
    ratios
        Shape (n, 2): middle and shortest side over the longest.
    is_left
        Shape (n,): the corners follow each other counter-clockwise, seen from inside the sphere.
    """

    corners: Indices
    log_longest: Array
    ratios: Array
    is_left: NDArray[np.bool_]


def triangles_of(directions: Array, corners: Indices, shortest_rad: float) -> Triangles:
    """Those of the triangles `corners` (n, 3) of unit vectors (m, 3) that are neither small nor flat."""
    points = directions[corners]
    sides = np.stack(
        [np.linalg.norm(points[:, (i + 1) % 3] - points[:, (i + 2) % 3], axis=-1) for i in range(3)], axis=-1
    )
    order = np.argsort(-sides, axis=-1)
    sides = np.take_along_axis(sides, order, axis=-1)
    corners = np.take_along_axis(corners, order, axis=-1)
    points = directions[corners]
    volume = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2]))
    good = (sides[:, 2] >= shortest_rad) & (np.abs(volume) >= FLATTEST * sides[:, 0] ** 2)
    sides = sides[good]
    # Seen from inside with the first direction's east to the left, a positive volume is a turn to the left.
    return Triangles(corners[good], np.log(sides[:, 0]), sides[:, 1:] / sides[:, :1], volume[good] > 0.0)


def all_corners(n: int) -> Indices:
    """Every three of `n` stars, shape (n (n-1) (n-2) / 6, 3)."""
    return np.array(list(combinations(range(n), 3)), dtype=np.int64).reshape(-1, 3)


def close_corners(directions: Array, longest_rad: float) -> Indices:
    """Every three of these stars (n, 3) that have no side longer than `longest_rad` (chord), shape (n_triangles, 3)."""
    pairs = cKDTree(directions).query_pairs(longest_rad, output_type="ndarray").astype(np.int64)
    pairs.sort(axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    first = np.searchsorted(pairs[:, 0], np.arange(len(directions) + 1))
    parts = []
    for star in range(len(directions)):
        later = pairs[first[star] : first[star + 1], 1]
        if later.size < 2:
            continue
        i, j = np.triu_indices(later.size, 1)
        parts.append(np.stack([np.full(i.size, star), later[i], later[j]], axis=-1))
    if not parts:
        return np.empty((0, 3), dtype=np.int64)
    corners = np.concatenate(parts)
    third = np.linalg.norm(directions[corners[:, 1]] - directions[corners[:, 2]], axis=-1)
    kept: Indices = corners[third <= longest_rad]
    return kept


def look_alikes(seen: Triangles, known: Triangles) -> tuple[Indices, Indices]:
    """Pairs of (index of a seen triangle, index of a known one) that look alike, mirrored or not."""
    if len(seen.corners) == 0 or len(known.corners) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    features = [
        np.column_stack([some.log_longest / SCALE_TOLERANCE, some.ratios / RATIO_TOLERANCE]) for some in (seen, known)
    ]
    # A million triangles, asked a hundred times: a tree that is quickly built serves better than a good one.
    tree = cKDTree(features[1], balanced_tree=False, compact_nodes=False)
    found = tree.query_ball_point(features[0], 1.0, p=np.inf)
    of_seen = np.repeat(np.arange(len(found)), [len(some) for some in found])
    return of_seen.astype(np.int64), np.concatenate([np.asarray(some, dtype=np.int64) for some in found])


def attitudes(seen: Array, known: Array) -> Array:
    """The turns (n, 3, 3) that bring unit vectors `seen` (n, k, 3) closest to `known` (n, k, 3).

    Source: the orthogonal Procrustes problem with determinant +1 (Kabsch 1976, Acta Cryst. A32, 922).
    """
    u, _, vt = np.linalg.svd(np.einsum("nki,nkj->nij", known, seen))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turns: Array = u @ vt
    return turns
