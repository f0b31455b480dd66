"""How gravity turns the facets: a model of their directions over zenith distance, from runs at several of them.

Of every run only what facets do relative to each other counts: the light-weighted mean of all facets' directions is
taken off first. What all facets do together moves the image and spreads no light; whether the structure bent or the
star camera did, no star can tell. The rest of facet j is Theta_j(z) = c_j + a_j sin z + b_j (cos z - 1), as elastic
structures bend in proportion to the weight across and along the axis. Play of the structure is told by runs to which
the telescope came from above (smaller zenith distances) and from below.

Which terms are needed is decided for all facets together, and whether a facet moves at all for each of them, both
by the Bayesian information criterion with the scatter that the runs themselves show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.play import Play, used_rad
from namod_ctl.calibration.gravity.relative_runs import RelativeRuns
from namod_ctl.calibration.gravity.sag_fit import TERMS, fit_facets, weights_of
from namod_ctl.calibration.gravity.sag_screening import odd_facets, refuse_turned, scatter2_of
from namod_ctl.calibration.gravity.sag_terms import TERM_CHANCE, TermTest, moving_facets, needed_terms
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_arcmin, rad_to_deg

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_RUNS = 3
MIN_SPAN_RAD, GOOD_SPAN_RAD = deg_to_rad(15.0), deg_to_rad(30.0)
SAME_ZENITH_RAD = deg_to_rad(3.0)  # runs that are nearer to each other tell nothing new about the form of the sag
MIN_COMMON_FACETS = 3
_N_SCREENINGS = 8
_DOUBTFUL_SCATTER = 2.0  # in stated errors


@dataclass(frozen=True, slots=True, eq=False)
class RunOfFacets:
    """What one reconstructed run says about the facets; NaN where it says nothing that may be used.

    Attributes
    ----------
    theta_rad, cov_rad2
        Shapes (n_facets, 2) and (n_facets, 2, 2). Direction of the star at which each facet is brightest.
    seen
        Shape (n_facets, n_moments). In which shares each facet was lit at the moments of the path: a star that wanders
        lights them one after the other, while the telescope leans over further.
    """

    name: str
    path: ZenithPath
    theta_rad: Array
    cov_rad2: Array
    seen: Array


@dataclass(frozen=True, slots=True, eq=False)
class SagFit:
    """The sag of all facets, relative to their light-weighted mean.

    Attributes
    ----------
    beta_rad, cov_rad2
        Shapes (n_facets, 1 + n_terms, 2) and (n_facets, 1 + n_terms, 2, 1 + n_terms, 2): constant, then `terms`.
        NaN for facets that could not be fitted. The covariance has the scatter of the runs in it.
    is_moving
        Shape (n_facets,). The facet's terms are worth their numbers; those of the others are left out of a table.
    chance
        Shape (n_facets,). With which chance alone would make a facet at rest look as it does.
    odd
        By the number of the facet: why it is left out, for a person.
    common_rad, common_sigma_rad
        Shape (n_runs, 2) each. Light-weighted mean direction of all facets, from the first run's.
    scatter
        Of the runs about the model, in stated errors; 1 when these are right.
    residual_rms_rad
        Per axis, about the model.
    """

    terms: tuple[str, ...]
    beta_rad: Array
    cov_rad2: Array
    is_moving: Mask
    chance: Array
    odd: dict[int, str]
    common_rad: Array
    common_sigma_rad: Array
    scatter: float
    residual_rms_rad: float
    tests: tuple[TermTest, ...]
    play: Play | None
    remarks: tuple[str, ...]
    is_good: bool


def fit_sag(runs: Sequence[RunOfFacets], light: Array) -> SagFit:
    """The sag model of all facets.

    Parameters
    ----------
    light
        Shape (n_facets,). How much each facet weighs in the image.

    Raises
    ------
    DataQualityError
        Too few runs, too small a span of zenith distances, too few facets that all runs know, or runs between which
        facets were turned.
    """
    remarks = _check_runs(runs)
    paths, seen = [run.path for run in runs], [run.seen for run in runs]
    theta = np.array([run.theta_rad for run in runs])
    cov = np.array([run.cov_rad2 for run in runs])
    is_seen = np.isfinite(theta).all(axis=-1) & np.isfinite(cov).all(axis=(-1, -2))
    theta, cov = np.where(is_seen[..., None], theta, 0.0), np.where(is_seen[..., None, None], cov, np.eye(2))
    candidates = _candidates(paths)
    n_facets = len(light)
    terms, play = candidates[-1], None
    for n_screenings in (0, _N_SCREENINGS, _N_SCREENINGS):
        # terms and hysteresis first, and again: with wrong ones facets that sag much would look odd
        odd: dict[int, str] = {}
        for left in range(n_screenings, -1, -1):
            share, common, common_cov, relative_cov = _common_motion(theta, cov, is_seen, light, odd)
            is_even = is_seen.any(axis=0) & ~np.isin(np.arange(n_facets), list(odd))
            relative = RelativeRuns(
                [run.name for run in runs], paths, seen, share, theta - common[:, None],
                weights_of(relative_cov, is_seen), is_even,
            )  # fmt: skip
            found = odd_facets(relative, terms, used_rad(play)) if left else {}
            if not found:
                break
            odd |= found
        can_tell = relative.fit(candidates[-1]).n_free > 0
        relative = replace(relative, is_even=is_even & can_tell)
        tests, terms, play = needed_terms(relative, candidates)
        if n_screenings and not odd:
            break
    refuse_turned(relative, candidates[-1], used_rad(play), odd)
    basis, rest = relative.settled(terms, used_rad(play))
    best = fit_facets(basis, rest, relative.weight)
    scatter2 = scatter2_of(best, relative.is_even)
    chance, is_moving = moving_facets(basis, rest, relative.weight, best, scatter2)
    is_moving &= ~np.isin(np.arange(n_facets), list(odd))
    scatter = math.sqrt(scatter2)
    if scatter > _DOUBTFUL_SCATTER:
        remarks.append(
            f"the runs scatter {scatter:.1f} times as much as their stated errors; the table's errors are widened so"
        )
    remarks += _remarks_on_play(paths, play, terms)
    n_unknown = int(np.count_nonzero(~np.isfinite(best.beta_rad).all(axis=(1, 2))))
    if n_unknown:
        remarks.append(f"{n_unknown} facets were seen in too few runs: they have no sag in the table")
    residual = best.residual_rad[:, relative.is_even]
    return SagFit(
        terms=terms,
        beta_rad=best.beta_rad,
        cov_rad2=best.cov_rad2 * max(scatter2, 1.0),
        is_moving=is_moving,
        chance=chance,
        odd=odd,
        common_rad=common - common[0],
        common_sigma_rad=np.sqrt(np.diagonal(common_cov, axis1=1, axis2=2)),
        scatter=scatter,
        residual_rms_rad=float(np.sqrt(np.nanmean(residual**2))),
        tests=tests,
        play=play,
        remarks=tuple(remarks),
        is_good=scatter <= _DOUBTFUL_SCATTER and _span_rad(paths) >= GOOD_SPAN_RAD,
    )


def _span_rad(paths: Sequence[ZenithPath]) -> float:
    means = [path.mean_rad for path in paths]
    return max(means) - min(means)


def _check_runs(runs: Sequence[RunOfFacets]) -> list[str]:
    if len(runs) < MIN_RUNS:
        raise DataQualityError(
            f"{len(runs)} runs: at least {MIN_RUNS} are needed, at different zenith distances (4 from 10 to 60 deg are "
            "good); record more, and turn no facet in between"
        )
    span_rad = _span_rad([run.path for run in runs])
    zeniths = ", ".join(f"{rad_to_deg(run.path.mean_rad):.0f}" for run in runs)
    if span_rad < MIN_SPAN_RAD:
        raise DataQualityError(
            f"the runs are at zenith distances of {zeniths} deg: a span of {rad_to_deg(span_rad):.0f} deg tells "
            f"nothing about gravity; at least {rad_to_deg(MIN_SPAN_RAD):.0f} deg are needed: record elsewhere"
        )
    if span_rad < GOOD_SPAN_RAD:
        return [
            f"the runs span only {rad_to_deg(span_rad):.0f} deg of zenith distance ({zeniths}): the table is good "
            "between them, hardly beyond"
        ]
    return []


def _candidates(paths: Sequence[ZenithPath]) -> list[tuple[str, ...]]:
    """Sets of terms that so many zenith distances can decide about, with one to spare; the largest one last."""
    means = sorted(path.mean_rad for path in paths)
    n_places = 1 + int(np.count_nonzero(np.diff(means) > SAME_ZENITH_RAD))
    if n_places < MIN_RUNS:
        raise DataQualityError(
            f"the runs are at {n_places} different zenith distances only; at least {MIN_RUNS} are needed"
        )
    one: list[tuple[str, ...]] = [(), ("sin",), ("cos",)]
    return [*one, TERMS] if n_places > MIN_RUNS else one[:2]


def _common_motion(
    theta: Array, cov: Array, is_seen: Mask, light: Array, odd: dict[int, str]
) -> tuple[Array, Array, Array, Array]:
    """Facets' shares in the mean of those that all runs know, the mean, its covariance, that of facets about it."""
    is_common = is_seen.all(axis=0) & (np.nan_to_num(light) > 0.0)
    is_common[list(odd)] = False
    if np.count_nonzero(is_common) < MIN_COMMON_FACETS:
        raise DataQualityError(
            f"only {np.count_nonzero(is_common)} facets are known well in all runs, at least {MIN_COMMON_FACETS} are "
            "needed: record longer, over the same region"
        )
    share = np.where(is_common, np.nan_to_num(light), 0.0)
    share /= share.sum()
    common = np.einsum("n,kna->ka", share, theta)
    common_cov = np.einsum("n,knab->kab", share**2, cov)
    relative_cov = (1.0 - 2.0 * share)[None, :, None, None] * cov + common_cov[:, None]
    return share, common, common_cov, relative_cov


def _remarks_on_play(paths: Sequence[ZenithPath], play: Play | None, terms: tuple[str, ...]) -> list[str]:
    if not terms:
        return ["no sag is seen: the facets stand as they do at all zenith distances, within the errors"]
    if play is None:
        sides = {round(path.side()) for path in paths if path.has_side}
        how = "all came from the same side" if len(sides) == 1 else "it is not known from which side they came"
        return [f"hysteresis was not measured: of the runs {how}; record some from the other side"]
    if play.is_significant and play.play_rad < 0.0:
        return ["the facets seem to lead instead of lag: are above and below exchanged in --from?"]
    if play.own_chance < TERM_CHANCE:
        return [
            "the hysteresis is not one play common to all facets: between the two sides they differ by a further "
            f"{rad_to_arcmin(play.own_rms_rad):.2f} arcmin (rms)"
        ]
    return []
