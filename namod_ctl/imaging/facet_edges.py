"""The camera's pose from a picture in which the facets' edges are visible: a proposal, to be confirmed by a person.

The outlines of all facets are projected; along the normal of every side the strongest change of brightness near by is
sought, and the pose is moved to where the outlines meet these, again and again in ever narrower reach.
Source: Harris, Tracking with rigid models, in: Active Vision (MIT Press 1992), as extended to search along normals by
Drummond and Cipolla, IEEE Trans. PAMI 24 (2002) 932. Facets are a lattice, so a pose moved by one facet fits nearly
as well: such rivals are tried, and a proposal is trusted only if it beats them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.camera_pose import CameraPose, PoseFamily, facet_corners_m, nominal_pose
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]
Map = NDArray[np.float32]

N_SAMPLES = 3000
STEPS_PER_ROUND = 15
"""Fewer do not let a fit arrive: its trust region begins small."""
QUICK_SHARE = 5
"""Of the samples, one in so many is enough to compare thousands of starts by."""
CORNER_MARGIN = 0.12
"""Of a side: near its ends the next side is as near."""
BLUR_PX = 1.0
STEP_PX = 0.5
FIRST_REACH = 0.3
LAST_REACH = 0.15
"""Of a facet's width: how far an edge is sought from where it is expected, first and last."""
MIN_REACH_PX = 3.0
N_ROUNDS = 8
HIT_PX = 1.5
"""An edge this near to where it is expected is one."""
MIN_SEEN_SHARE = 0.75
"""Of the facets, with half of their outline met by edges, for a proposal to be trusted."""
MIN_LEAD_SIGMA = 4.0
"""By which its number of met edges must exceed that of every rival."""
SAME_POSE_PX = 2.0
MAX_LATTICE_STEPS = 8
"""Facets by which a first guess may be off."""
N_FINALISTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """A pose fitted to the edges in a picture.

    Attributes
    ----------
    hit_share
        By facet id: share of the facet's outline in the image that an edge meets within `HIT_PX`.
    rms_px
        Root mean square distance of these edges from the outlines.
    n_hits, n_samples
        Points of all outlines with an edge, and all that lie in the image.
    """

    pose: CameraPose
    hit_share: Mapping[int, float]
    rms_px: float
    n_hits: int
    n_samples: int

    @property
    def seen_share(self) -> float:
        """Share of the facets with at least half of their outline met."""
        return float(np.mean([share >= 0.5 for share in self.hit_share.values()])) if self.hit_share else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """The best fit, and what speaks against it (empty: it can be trusted, but a person still confirms it)."""

    fit: EdgeFit
    doubts: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Points along all outlines: index of the facet (n,), place (n, 3) and a point a little further along (n, 3)."""

    facet: NDArray[np.intp]
    points_m: Array
    ahead_m: Array


class EdgePicture:
    """A picture of the reflector and what of its edges lies where the outlines of a reflector should be.

    `image` has the shape (rows, columns) or (rows, columns, 3), 8 bit, and is the camera's whole frame.
    """

    def __init__(self, image: NDArray[np.uint8], reflector: Reflector, camera: CameraModel) -> None:
        if image.shape[:2] != (camera.n_rows, camera.n_columns):
            raise ConfigError(
                f"the picture has {image.shape[1]} x {image.shape[0]} pixels, the reflector camera "
                f"{camera.n_columns} x {camera.n_rows}: give the whole frame of this camera"
            )
        grey = image.astype(np.float32).mean(axis=2) if image.ndim == 3 else image.astype(np.float32)
        smooth = cv2.GaussianBlur(np.sqrt(grey), (0, 0), BLUR_PX)  # the root: equal noise in bright and dark parts
        self._slope = (cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
        self._reflector, self._camera = reflector, camera
        self._samples = _sampled(facet_corners_m(reflector), reflector)
        self._n_facets = len(reflector.facets)

    def facet_width_px(self, pose: CameraPose) -> float:
        """Smallest width of a facet in the image."""
        widths = [facet.width_m for facet in self._reflector.facets]
        return min(widths) / self._reflector.focal_length_m * pose.focal_px

    def refine(self, start: CameraPose) -> EdgeFit:
        """The pose near `start` whose outlines meet the picture's edges best."""
        pose = start
        width_px = self.facet_width_px(start)
        for reach_px in np.geomspace(FIRST_REACH * width_px, max(LAST_REACH * width_px, MIN_REACH_PX), N_ROUNDS):
            seen, normal, offset_px, weight = self._edges(pose, max(float(reach_px), MIN_REACH_PX))
            if np.count_nonzero(weight) < 20:
                break
            pose = self._moved(pose, seen, normal, offset_px, weight)
        return self.judge(pose)

    def judge(self, pose: CameraPose) -> EdgeFit:
        """How well the picture's edges meet the outlines of this pose."""
        seen, _, offset_px, weight = self._edges(pose, max(LAST_REACH * self.facet_width_px(pose), 2.0 * MIN_REACH_PX))
        facet = self._samples.facet[seen]
        is_hit = (np.abs(offset_px) <= HIT_PX) & (weight > 0.0)
        hits = np.bincount(facet, weights=is_hit, minlength=self._n_facets)
        counts = np.bincount(facet, minlength=self._n_facets)
        ids = self._reflector.ids
        shares = {ids[j]: float(hits[j] / counts[j]) for j in range(self._n_facets) if counts[j] > 0}
        rms_px = float(np.sqrt(np.mean(offset_px[is_hit] ** 2))) if is_hit.any() else math.inf
        return EdgeFit(pose, shares, rms_px, int(hits.sum()), int(counts.sum()))

    def _outline(self, pose: CameraPose, step: int = 1) -> tuple[NDArray[np.intp], Array, Array]:
        """The samples in the image (every so many of them): index, place (n, 2) and outward normal (n, 2)."""
        places = pose.project(self._samples.points_m[::step])
        along = pose.project(self._samples.ahead_m[::step]) - places
        size = (self._camera.n_columns - 1, self._camera.n_rows - 1)
        seen = np.flatnonzero(((places >= 0) & (places <= size)).all(axis=1))  # also without those of no place
        along = along[seen] / np.linalg.norm(along[seen], axis=1, keepdims=True)
        return seen, places[seen], along[:, ::-1] * (1.0, -1.0)

    def _rise(self, places: Array, normal: Array) -> Array:
        """Slope of the picture along `normal`; both (..., 2)."""
        x, y = (np.ascontiguousarray(places[..., axis], dtype=np.float32) for axis in (0, 1))
        gx, gy = (cv2.remap(s, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for s in self._slope)
        rise: Array = gx.astype(np.float64) * normal[..., 0] + gy.astype(np.float64) * normal[..., 1]
        return rise

    def _edges(self, pose: CameraPose, reach_px: float) -> tuple[NDArray[np.intp], Array, Array, Array]:
        """The strongest edge along each sample's normal: samples, normals, offsets (px) and weights (0 for no edge)."""
        seen, places, normal = self._outline(pose)
        if seen.size == 0:
            return seen, normal, np.empty(0), np.empty(0)
        offsets = np.arange(-reach_px, reach_px + STEP_PX / 2.0, STEP_PX)
        rises = self._rise(places[:, None] + offsets[:, None] * normal[:, None], normal[:, None])
        rises *= np.exp(-0.5 * (offsets / reach_px) ** 2)
        facet = self._samples.facet[seen]
        # A facet is brighter than what is around it, or darker, but all around: the gap's other side is not its edge.
        balance = np.bincount(facet, weights=np.max(rises, axis=1) + np.min(rises, axis=1), minlength=self._n_facets)
        sign = np.where(balance >= 0.0, 1.0, -1.0)[facet]
        signed = rises * sign[:, None]
        best = np.argmax(signed, axis=1)
        strength = signed[np.arange(len(best)), best]
        noise = 1.4826 * np.median(np.abs(signed))
        is_edge = strength > 3.0 * noise
        return seen, normal, offsets[best], np.where(is_edge, 1.0, 0.0)

    def _moved(
        self, pose: CameraPose, seen: NDArray[np.intp], normal: Array, offset_px: Array, weight: Array
    ) -> CameraPose:
        """The pose whose outlines meet these edges; edges far off the others pull no harder than near ones."""
        family = PoseFamily(pose, self._reflector, self._camera, has_distortion=True)
        is_edge = weight > 0.0
        points_m, normal = self._samples.points_m[seen[is_edge]], normal[is_edge]
        target_px = np.sum(normal * pose.project(points_m), axis=1) + offset_px[is_edge]
        behind_px = 1e4

        def misfit(numbers: Array) -> Array:
            moved = family.pose(numbers)
            off = np.nan_to_num(target_px - np.sum(normal * moved.project(points_m), axis=1), nan=behind_px)
            soft = np.sqrt(2.0 * (np.sqrt(1.0 + off**2) - 1.0))  # so that the prior stays a parabola
            return np.concatenate([soft, family.prior(moved)])

        return family.pose(least_squares(misfit, np.zeros(family.n_numbers), x_scale="jac", max_nfev=STEPS_PER_ROUND).x)

    def brightness_of(self, pose: CameraPose) -> float:
        """Mean steepness of the picture across the outlines of the pose: a quick measure to compare starts by."""
        seen, places, normal = self._outline(pose, QUICK_SHARE)
        return float(np.mean(np.abs(self._rise(places, normal)))) if seen.size else 0.0


def _sampled(corners_m: Mapping[int, Array], reflector: Reflector) -> _Samples:
    n_sides = sum(len(corners) for corners in corners_m.values())
    n_per_side = max(1, min(24, N_SAMPLES // n_sides))
    shares = CORNER_MARGIN + (1.0 - 2.0 * CORNER_MARGIN) * (np.arange(n_per_side) + 0.5) / n_per_side
    facets, points, ahead = [], [], []
    for j, facet_id in enumerate(reflector.ids):
        start = corners_m[facet_id]
        side = np.roll(start, -1, axis=0) - start
        points.append((start[:, None] + shares[:, None] * side[:, None]).reshape(-1, 3))
        ahead.append(points[-1] + 0.02 * np.repeat(side, n_per_side, axis=0))
        facets.append(np.full(len(points[-1]), j))
    return _Samples(np.concatenate(facets), np.concatenate(points), np.concatenate(ahead))


def propose_from_marks(picture: EdgePicture, reflector: Reflector, start: CameraPose) -> Proposal:
    """The pose near that of marks (which is good to a third of a facet) that a picture's edges suggest, with doubts."""
    fit = picture.refine(start)
    doubts = list(_poorly_seen(fit))
    moved_px, limit_px = _distance_px(fit.pose, start, reflector), 0.5 * picture.facet_width_px(start)
    if not moved_px <= limit_px:
        doubts.append(
            f"the edges lead {moved_px:.0f} px away from the marks, more than half a facet ({limit_px:.0f} px)"
        )
    return Proposal(fit, tuple(doubts))


def propose_without_marks(picture: EdgePicture, reflector: Reflector, camera: CameraModel) -> Proposal:
    """The pose that a picture's edges suggest near the config's, with doubts.

    Which facet is which rests on the config alone: a dish that looks the same when turned or mirrored cannot tell.
    """
    fits = [picture.refine(pose) for pose in _finalists(picture, reflector, camera)]
    best = max(fits, key=lambda fit: fit.n_hits)
    for _ in range(MAX_LATTICE_STEPS):
        fits += [picture.refine(pose) for pose in _moved_by_one(best.pose, reflector)]
        leader = max(fits, key=lambda fit: fit.n_hits)
        if leader is best:
            break
        best = leader
    rivals = [fit for fit in fits if not _distance_px(fit.pose, best.pose, reflector) <= SAME_POSE_PX]
    return Proposal(best, (*_poorly_seen(best), *_rivalled(best, rivals)))


def _poorly_seen(fit: EdgeFit) -> Iterator[str]:
    if fit.seen_share < MIN_SEEN_SHARE:
        yield (
            f"the edges of only {fit.seen_share:.0%} of the facets were found, {MIN_SEEN_SHARE:.0%} are needed: take a "
            "picture in daylight or twilight, or mark facets by hand"
        )


def _rivalled(best: EdgeFit, rivals: list[EdgeFit]) -> Iterator[str]:
    rival = max(rivals, key=lambda fit: fit.n_hits, default=None)
    if rival is None:
        return
    misses = (best.n_samples - best.n_hits) + (rival.n_samples - rival.n_hits)
    if best.n_hits - rival.n_hits < MIN_LEAD_SIGMA * math.sqrt(max(misses, 1)):
        yield (
            f"another pose, moved by about a facet or turned, meets {rival.n_hits} edge points, this one "
            f"{best.n_hits}, of {best.n_samples}: mark 4 facets by hand to decide"
        )


def _distance_px(one: CameraPose, other: CameraPose, reflector: Reflector) -> float:
    """Median distance of the facets' centres in two views."""
    away_px = one.project(reflector.positions_m) - other.project(reflector.positions_m)
    return float(np.median(np.linalg.norm(away_px, axis=1)))


def _pitch_m(reflector: Reflector) -> float:
    """Distance of a facet to its nearest neighbour, the median of all."""
    across = reflector.positions_m[:, :2]
    distance = np.linalg.norm(across[:, None] - across[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def _aimed(pose: CameraPose, right_rad: float, down_rad: float) -> CameraPose:
    """The pose with the camera aimed a little further right and down in its image."""
    turn = cv2.Rodrigues(np.array([down_rad, -right_rad, 0.0]))[0]
    return replace(pose, axes=turn @ pose.axes)


def _moved_by_one(pose: CameraPose, reflector: Reflector) -> list[CameraPose]:
    """Poses in which the reflector appears moved by one facet, to six sides."""
    if len(reflector.facets) < 2:
        return []
    step_rad = _pitch_m(reflector) / reflector.focal_length_m
    angles = pose.rotation_rad + np.arange(6) * math.tau / 6.0
    return [_aimed(pose, step_rad * math.cos(a), step_rad * math.sin(a)) for a in angles]


def _finalists(picture: EdgePicture, reflector: Reflector, camera: CameraModel) -> list[CameraPose]:
    """The most promising of all scales, aims and small turns about those of the config."""
    nominal = nominal_pose(reflector, camera)
    pitch_rad = _pitch_m(reflector) / reflector.focal_length_m if len(reflector.facets) > 1 else 0.01
    reach = float(np.linalg.norm(reflector.positions_m[:, :2], axis=1).max()) / reflector.focal_length_m
    scale_step = min(0.2 * pitch_rad / max(reach, pitch_rad), 0.05)
    scales = np.exp(np.arange(math.log(0.75), math.log(1.25), scale_step))
    turns = np.arange(-2, 3) * min(0.2 * pitch_rad / max(reach, pitch_rad), 0.02)
    aims = np.arange(-2, 3) * 0.2 * pitch_rad
    tried = []
    for scale in scales:
        for turn in turns:
            axes = cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0] @ nominal.axes
            for right in aims:
                for down in aims:
                    pose = _aimed(replace(nominal, axes=axes, focal_px=nominal.focal_px * scale), right, down)
                    tried.append((picture.brightness_of(pose), pose))
    tried.sort(key=lambda pair: -pair[0])
    chosen: list[CameraPose] = []
    for _, pose in tried:
        if all(_distance_px(pose, other, reflector) > 0.25 * picture.facet_width_px(pose) for other in chosen):
            chosen.append(pose)
        if len(chosen) == N_FINALISTS:
            break
    return chosen
