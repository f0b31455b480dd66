"""From a few facets that a person marked in the reflector camera's image to the camera's pose, or to what is wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.camera_pose import (
    MAX_STEPS,
    MIN_FACETS_FOR_DISTORTION,
    CameraPose,
    PointPairs,
    PoseFit,
    facet_corners_m,
    fit_pose,
    starting_poses,
)
from namod_ctl.optics.polygons import crossing_sides, polygon_area_px2, polygon_centre_px
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

MIN_MARKS = 4
MAX_RESIDUAL_PX = 5.0
"""Of a mark in an image of 1000 columns: larger ones are no slips of the hand. At most half a facet."""
MAX_PLACE_SHARE = 0.3
"""Of the focal length: no reflector camera is further from the focal point."""
MIN_SPREAD_SHARE = 0.05
"""Narrowest extent of the marks across the reflector, as a share of their longest."""
TRIAL_STEPS = 15
"""Of a fit that tries whether a mistake would explain the marks: a right guess needs less."""
MAX_SUSPECTS = 12
"""Marks that are tried exchanged in pairs."""


class MarksError(ConfigError):
    """The marks cannot be right; `facet_ids` are those to look at."""

    def __init__(self, text: str, facet_ids: Iterable[int] = ()) -> None:
        super().__init__(text)
        self.facet_ids = tuple(facet_ids)


@dataclass(frozen=True, slots=True, eq=False)
class MarkedPose:
    """The camera's pose as marks give it.

    Attributes
    ----------
    residual_px
        By facet id: root mean square distance of the facet's marked points from where the pose puts them.
    rms_px
        The same over all points.
    """

    fit: PoseFit
    residual_px: Mapping[int, float]
    rms_px: float

    @property
    def pose(self) -> CameraPose:
        """The most probable pose."""
        return self.fit.pose

    def uncertainty_px(self, reflector: Reflector) -> float:
        """Largest expected error of any facet's centre in the image, one standard deviation."""
        return float(self.fit.uncertainty_px(reflector.positions_m).max())


def pose_of_marks(
    marks_px: Mapping[int, Array], reflector: Reflector, camera: CameraModel, is_mirrored: bool | None = None
) -> MarkedPose:
    """The pose of the reflector camera from at least 4 marked facets.

    Parameters
    ----------
    marks_px
        By facet id: shape (1, 2), the place of the facet's centre, or (n_corners, 2), its outline; (x, y) pixel.
    is_mirrored
        As the camera's config says; None tries both.

    Raises
    ------
    MarksError
        For too few marks, unknown ids, marks on one line, or marks that do not fit a camera near the focal point. What
        would fit (a mark left out, two ids exchanged, a mirrored image) is named with its numbers.
    """
    _refuse_impossible(marks_px, reflector)
    senses = (False, True) if is_mirrored is None else (is_mirrored,)
    found = [_solve(marks_px, reflector, camera, sense, max_steps=MAX_STEPS) for sense in senses]
    # Marks that are not on one line cannot fit both senses: the other one's residuals are as wide as the marks spread.
    good = [solution for solution in found if _is_good(solution, reflector, camera)]
    if good:
        return min(good, key=lambda solution: solution.fit.cost)
    raise _diagnosis(marks_px, reflector, camera, senses, min(found, key=lambda s: s.fit.cost))


def _refuse_impossible(marks_px: Mapping[int, Array], reflector: Reflector) -> None:
    unknown = sorted(set(marks_px) - set(reflector.ids))
    if unknown:
        raise MarksError(f"facets {unknown} are marked, but the reflector has none of these ids: correct them", unknown)
    if len(marks_px) < MIN_MARKS:
        raise MarksError(f"{len(marks_px)} facets are marked; at least {MIN_MARKS} are needed, spread over the dish")
    for facet_id, points in marks_px.items():
        if not np.isfinite(points).all() or len(points) not in (1, *range(3, 1000)):
            raise MarksError(
                f"facet {facet_id}: {len(points)} points are marked; give its centre, or the corners of its outline",
                [facet_id],
            )
        if len(points) > 1 and (crossing_sides(points) is not None or polygon_area_px2(points) <= 0.0):
            raise MarksError(f"facet {facet_id}: its marked outline crosses itself: draw it anew", [facet_id])
    by_id = {facet.id: facet.position_m for facet in reflector.facets}
    centres_px = np.array([centre_of_mark(points) for points in marks_px.values()])
    ids = list(marks_px)
    for first, second in combinations(range(len(ids)), 2):
        if np.linalg.norm(centres_px[first] - centres_px[second]) < 1.0:
            pair = (ids[first], ids[second])
            raise MarksError(f"facets {pair[0]} and {pair[1]} are marked at the same place: correct one of them", pair)
    for what, places in (
        ("facets", np.array([by_id[i][:2] for i in ids])),
        ("marks", centres_px),
    ):
        extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if extents[1] < MIN_SPREAD_SHARE * extents[0]:
            raise MarksError(
                f"the marked {what} lie on one line (their spread across it is {extents[1] / extents[0]:.1%} of that "
                f"along it, at least {MIN_SPREAD_SHARE:.0%} is needed), and could as well be mirrored: mark facets "
                "that are spread over the whole dish"
            )


def centre_of_mark(points_px: Array) -> Array:
    """Centre of gravity, shape (2,), of a marked outline's area; a single point itself."""
    if len(points_px) < 3:
        return np.asarray(points_px[0], dtype=np.float64)
    return polygon_centre_px(points_px)


def _solve(
    marks_px: Mapping[int, Array],
    reflector: Reflector,
    camera: CameraModel,
    is_mirrored: bool,
    robust: bool = False,
    max_steps: int = TRIAL_STEPS,
) -> MarkedPose:
    ids = tuple(marks_px)
    marked = reflector.subset(ids)
    centres_m = dict(zip(ids, marked.positions_m, strict=True))
    pairs = PointPairs(ids, marked.positions_m, np.array([centre_of_mark(points) for points in marks_px.values()]))
    starts = starting_poses(pairs, reflector, camera, is_mirrored)
    fit = fit_pose(pairs, starts, reflector, camera, robust=robust, max_steps=max_steps)
    corners_m = facet_corners_m(marked)
    if any(len(marks_px[i]) == len(corners_m[i]) for i in ids):
        pairs = _with_corners(marks_px, corners_m, centres_m, fit.pose)
        fit = fit_pose(pairs, [fit.pose], reflector, camera, robust=robust, max_steps=max_steps)
    squares = np.sum(fit.residual_px**2, axis=1)
    of_facet = np.array(pairs.facet_ids)
    residual_px = {i: float(np.sqrt(squares[of_facet == i].mean())) for i in ids}
    return MarkedPose(fit, residual_px, float(np.sqrt(squares.mean())))


def _with_corners(
    marks_px: Mapping[int, Array], corners_m: Mapping[int, Array], centres_m: Mapping[int, Array], pose: CameraPose
) -> PointPairs:
    """Corner by corner where an outline has as many as the facet, else the centre of gravity."""
    ids: list[int] = []
    points_m: list[Array] = []
    pixels: list[Array] = []
    for facet_id, marked in marks_px.items():
        if len(marked) == len(corners_m[facet_id]):
            expected = pose.project(corners_m[facet_id])
            expected = expected - np.nanmean(expected, axis=0) + centre_of_mark(marked)
            turns = [np.roll(c, k, axis=0) for c in (marked, marked[::-1]) for k in range(len(marked))]
            pixels.append(min(turns, key=lambda turned: float(np.sum((turned - expected) ** 2))))
            points_m.append(corners_m[facet_id])
        else:
            pixels.append(centre_of_mark(marked)[None])
            points_m.append(centres_m[facet_id][None])
        ids += [facet_id] * len(pixels[-1])
    return PointPairs(tuple(ids), np.concatenate(points_m), np.concatenate(pixels))


def tolerance_px(pose: CameraPose, reflector: Reflector, camera: CameraModel) -> float:
    """Largest residual of a mark that can be right."""
    width_px = min(facet.width_m for facet in reflector.facets) / reflector.focal_length_m * pose.focal_px
    return min(MAX_RESIDUAL_PX * max(camera.n_columns / 1000.0, 0.5), 0.5 * width_px)


def _is_good(solution: MarkedPose, reflector: Reflector, camera: CameraModel) -> bool:
    focus_m = np.array([0.0, 0.0, reflector.focal_length_m])
    away = float(np.linalg.norm(solution.pose.place_m - focus_m)) / reflector.focal_length_m
    is_near = max(solution.residual_px.values()) <= tolerance_px(solution.pose, reflector, camera)
    return is_near and away <= MAX_PLACE_SHARE and solution.pose.axes[2, 2] < 0.0


def _diagnosis(
    marks_px: Mapping[int, Array],
    reflector: Reflector,
    camera: CameraModel,
    senses: tuple[bool, ...],
    wrong: MarkedPose,
) -> MarksError:
    """What to tell about marks that do not fit: every simple mistake that would explain all of it."""
    explanations: list[tuple[str, tuple[int, ...]]] = []
    ids = list(marks_px)
    for sense in {False, True} - set(senses):
        solution = _solve(marks_px, reflector, camera, sense)
        if _is_good(solution, reflector, camera):
            state = "mirrored" if sense else "not mirrored"
            explanations.append(
                (f"the image is {state} (then {solution.rms_px:.1f} px rms): correct reflector_camera.mirrored", ())
            )
    suspects = _suspects(marks_px, reflector, camera, senses)
    for first, second in combinations(suspects, 2):
        changed = dict(marks_px) | {first: marks_px[second], second: marks_px[first]}
        for sense in senses:
            solution = _solve(changed, reflector, camera, sense)
            if _is_good(solution, reflector, camera):
                text = f"the ids of {first} and {second} are exchanged (then {solution.rms_px:.1f} px rms)"
                explanations.append((text, (first, second)))
    if len(ids) > MIN_MARKS:
        for left_out in suspects:
            rest = {i: points for i, points in marks_px.items() if i != left_out}
            for sense in senses:
                solution = _solve(rest, reflector, camera, sense)
                if _is_good(solution, reflector, camera):
                    text = _misplaced(left_out, marks_px[left_out], solution, reflector, camera)
                    explanations.append((text, (left_out,)))
    residuals = ", ".join(f"{i}: {wrong.residual_px[i]:.1f} px" for i in ids[:30])
    focus_m = np.array([0.0, 0.0, reflector.focal_length_m])
    away_m = float(np.linalg.norm(wrong.pose.place_m - focus_m))
    facts = (
        f"the marks do not fit the reflector: {wrong.rms_px:.1f} px rms with the camera {away_m:.2g} m from the focal "
        f"point (facet: residual; {residuals})"
    )
    if len(ids) < MIN_FACETS_FOR_DISTORTION:
        facts += f"; a lens with distortion needs {MIN_FACETS_FOR_DISTORTION} marks"
    named = tuple(dict.fromkeys(i for _, those in explanations for i in those))
    if len(explanations) == 1:
        return MarksError(f"{explanations[0][0]}; as it stands {facts}", named)
    if explanations:
        return MarksError(
            f"{facts}. Each of these alone would explain it: {'; '.join(text for text, _ in explanations)}. "
            "Look at them, or mark one facet more to decide",
            named,
        )
    return MarksError(f"{facts}. No single wrong mark explains it: check all ids, or mark more facets", tuple(ids))


def _suspects(
    marks_px: Mapping[int, Array], reflector: Reflector, camera: CameraModel, senses: tuple[bool, ...]
) -> list[int]:
    """The marks that a fit which is not pulled by outliers leaves furthest off; all of them where they are few."""
    if len(marks_px) <= MAX_SUSPECTS:
        return list(marks_px)
    robust = min(
        (_solve(marks_px, reflector, camera, sense, robust=True) for sense in senses), key=lambda s: s.fit.cost
    )
    return sorted(marks_px, key=lambda i: -robust.residual_px[i])[:MAX_SUSPECTS]


def _misplaced(facet_id: int, mark_px: Array, solution: MarkedPose, reflector: Reflector, camera: CameraModel) -> str:
    away_px = np.linalg.norm(solution.pose.project(reflector.positions_m) - centre_of_mark(mark_px), axis=1)
    own = reflector.ids.index(facet_id)
    nearest = int(np.nanargmin(away_px))
    place = (
        f"where facet {reflector.ids[nearest]} is"
        if away_px[nearest] <= tolerance_px(solution.pose, reflector, camera)
        else "where no facet's centre is"
    )
    return f"the mark of {facet_id} is {away_px[own]:.0f} px off, {place} (without it {solution.rms_px:.1f} px rms)"


def turn_note(pose: CameraPose, camera: CameraModel, limit_rad: float) -> str | None:
    """A warning if the image is turned otherwise in the telescope frame than the config says; else None."""
    off = pose.rotation_rad - camera.orientation.rotation_rad
    off = float((off + np.pi) % (2.0 * np.pi) - np.pi)
    if abs(off) <= limit_rad:
        return None
    return (
        f"the image is turned by {rad_to_deg(pose.rotation_rad):.1f} deg in the telescope frame, the config says "
        f"rotation_deg = {rad_to_deg(camera.orientation.rotation_rad):.1f}: instructions would show bolts turned by "
        "the difference; correct reflector_camera.rotation_deg, or the marks' ids"
    )
