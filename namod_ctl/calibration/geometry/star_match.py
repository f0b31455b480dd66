"""Which stars of the catalogue the stars of a frame are, or the reason why that cannot be said.

A match is believed only when chance would not make one as good in a million searches, when no other contradicts it, and
when neither too many catalogue stars are missing in the frame nor too many bright strangers are in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from namod_ctl.calibration.geometry.plate_solution import LensPriors
from namod_ctl.calibration.geometry.star_search import MIN_STARS, FieldMatch, FieldSearch, KnownStars, SeenStars
from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

MAX_FALSE_EXPECTED = 1e-6
"""Number of solutions as good as the one believed that chance makes in one search."""

AMBIGUOUS_RATIO = 1e3
"""A second solution that chance makes only so many times more often than the first one stands against it."""

MOST_STRANGERS, STRANGERS_PER_STAR = 4, 0.5
"""Bright lights that are no catalogue stars: a few hot pixels, a planet; of a rich field more."""

MOST_MISSING, MISSING_PER_STAR = 2, 1.0
"""Bright catalogue stars that are not seen: some clouds, a variable star."""


def known_stars(
    directions: Array, magnitude: Array, is_disturbed: NDArray[np.bool_], star_size_rad: float
) -> KnownStars:
    """The stars (n, 3) of a catalogue that a camera can tell apart.

    Stars with NaN for a direction do not come into question. Of stars closer together than two diameters none counts.
    """
    number = np.flatnonzero(np.isfinite(directions[:, 0]))
    is_single = np.ones(number.size, dtype=np.bool_)
    if number.size:
        pairs = cKDTree(directions[number]).query_pairs(2.0 * star_size_rad, output_type="ndarray")
        is_single[pairs.ravel()] = False
    number = number[is_single]
    return KnownStars(directions[number], magnitude[number], ~is_disturbed[number], number.astype(np.int64))


def match_field(seen: SeenStars, known: KnownStars, camera: CameraModel, priors: LensPriors) -> FieldMatch:
    """Which known stars the seen ones are, and the plate that says so.

    Raises
    ------
    DataQualityError
        Too few stars, no solution that chance would not make as well, or two that contradict each other.
    """
    if len(seen.pixel) < MIN_STARS:
        raise DataQualityError(
            f"{len(seen.pixel)} stars in the frame (needed: {MIN_STARS + 1}, better 8): expose longer, wait for clouds "
            "to pass, or choose a field with more bright stars"
        )
    search = FieldSearch(seen, known, camera, priors)
    found = sorted(search.solutions(), key=lambda match: (match.false_expected, match.fit.rms_px))
    if not found:
        raise DataQualityError(
            f"none of the {len(known.number)} catalogue stars that were tried fit the {len(seen.pixel)} stars of the "
            f"frame. {_WHAT_MAY_BE_WRONG}"
        )
    best = found[0]
    if best.false_expected > MAX_FALSE_EXPECTED:
        raise DataQualityError(
            f"the best match explains {len(best.seen)} of the frame's stars, but chance alone makes "
            f"{best.false_expected:.1g} such matches in one search (limit {MAX_FALSE_EXPECTED:g}). {_WHAT_MAY_BE_WRONG}"
        )
    for other in found[1:]:
        if other.false_expected < max(MAX_FALSE_EXPECTED, AMBIGUOUS_RATIO * best.false_expected) and not _is_same(
            best, other, camera
        ):
            raise DataQualityError(
                f"two different fields fit the frame ({best.false_expected:.1g} and {other.false_expected:.1g} such "
                "matches expected by chance): say where the camera looked (--near, --radius)"
            )
    _check_what_is_left(best)
    return best


_WHAT_MAY_BE_WRONG = (
    "Is it the star camera's frame and does the config's plate scale fit within 10 %? Say where the camera looked "
    "(--near, --radius), or take frames of a field with more bright stars, free of clouds"
)


def _check_what_is_left(match: FieldMatch) -> None:
    """Raises DataQualityError when too much in the frame speaks against the match."""
    n = len(match.seen)
    if len(match.missing) > max(MOST_MISSING, MISSING_PER_STAR * n):
        raise DataQualityError(
            f"{n} stars match, but {len(match.missing)} of the catalogue that are as bright and should be in the frame "
            "are missing: clouds? Take the frames again under a clear sky"
        )
    if len(match.strangers) > max(MOST_STRANGERS, STRANGERS_PER_STAR * n):
        raise DataQualityError(
            f"{n} stars match, but {len(match.strangers)} others as bright are in no catalogue: take dark frames "
            "(hot pixels), and frames without lamps, planes and satellites"
        )


def _is_same(one: FieldMatch, other: FieldMatch, camera: CameraModel) -> bool:
    """Do both plates put the corners of the image on the same places?"""
    corners = np.array([[0.0, 0.0], [camera.n_columns, 0.0], [0.0, camera.n_rows], [camera.n_columns, camera.n_rows]])
    apart = one.fit.plate.directions_of(corners) - other.fit.plate.directions_of(corners)
    return bool(np.linalg.norm(apart, axis=1).max() < 100.0 * camera.plate_scale_rad)
