"""How well a story of what the legs did explains the change of a facet's direction: the likelihood of learn and manual.

A leg travel vector c changes the facet's tilt by M c, and Theta by 2 M c (M from the mount). An observation is one
correction: the travels per facet, and estimates of Theta before and after. Between both all facets may shift alike, by
what the star camera's axis moved: estimated from the facets that behave, and taken off.

The change of Theta is normally distributed around what a story says, with the covariance of
both estimates + of the common shift + lost or uncertain travel of every leg that moved + the tolerance of the mount's
response (shared by all observations of a facet). Where the estimate after one correction is also the one before the
next, the noise that both changes share is in the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.optics.mounts import Mount

Array = NDArray[np.float64]
Estimate = tuple[Array, Array]

# A deviation counts from four standard deviations (of a normal distribution, both sides) on.
CHANCE_OF_FALSE_ALARM = float(2.0 * norm.sf(4.0))
# Prior of what the star camera's axis may move between two recordings, per axis: flexure of its support.
SHIFT_SIGMA_RAD = arcmin_to_rad(0.5)
# Fewer facets than this that agree on a shift are no witnesses; it then stays at its prior.
_LEAST_WITNESSES = 4
_LEAST_SHARE_OF_WITNESSES = 0.4
# A step for the derivative of a mount's kinematics: large against rounding, small against the mount (0.1 m and more).
_STEP_M = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One correction and what was seen of it.

    Attributes
    ----------
    travels_m
        Per facet, shape (n_legs,): travel of each leg as its drive tells it (readback after - before), or as it was
        asked of a person. A facet that is not named was not moved. NaN where nobody knows: the facet's part in this
        observation is then left out.
    before, after
        Per facet: Theta (2,) in rad and its covariance (2, 2) in rad^2. Facets without an estimate are missing or NaN.
    """

    travels_m: Mapping[int, Array]
    before: Mapping[int, Estimate]
    after: Mapping[int, Estimate]


@dataclass(frozen=True, slots=True, eq=False)
class FacetHistory:
    """All that was seen of one facet.

    Attributes
    ----------
    cycles
        Indices of the n observations in which the facet was seen.
    travel_m
        Shape (n, n_legs). What its own legs were told to travel.
    change_rad
        Shape (n, 2). Change of Theta less the common shift.
    noise_rad2
        Shape (2 n, 2 n). Covariance of `change_rad` by the estimates and the shift alone.
    response_rad_per_m
        Shape (2, n_legs). Nominal change of Theta per leg travel.
    leg_sigma_m
        Standard deviation of lost or uncertain travel of a leg that moved.
    spread
        Standard deviation of each leg's response relative to the nominal one.
    wide_rad
        Shape (n,). Standard deviation per axis of an unknown change: twice what is usual for all facets.
    """

    facet_id: int
    cycles: tuple[int, ...]
    travel_m: Array
    change_rad: Array
    noise_rad2: Array
    response_rad_per_m: Array
    leg_sigma_m: float
    spread: float
    wide_rad: Array

    @property
    def expected_rad(self) -> Array:
        """Change of Theta if all legs did as told, shape (n, 2)."""
        change: Array = self.travel_m @ self.response_rad_per_m.T
        return change

    def response_variance(self) -> Array:
        """Prior variance of both components of each leg's response, shape (n_legs,), (rad/m)^2."""
        variance: Array = self.spread**2 * np.sum(self.response_rad_per_m**2, axis=0)
        return variance

    def covariance_rad2(self, travel_m: Array) -> Array:
        """Covariance of `change_rad` for the travels that the legs really made.

        Parameters
        ----------
        travel_m
            Shape (n_stories, n, n_legs).

        Returns
        -------
        Shape (n_stories, 2 n, 2 n).
        """
        n_stories, n, _ = travel_m.shape
        covariance = np.broadcast_to(self.noise_rad2, (n_stories, 2 * n, 2 * n)).reshape(n_stories, n, 2, n, 2).copy()
        tolerance = np.einsum("snl,sml,l->snm", travel_m, travel_m, self.response_variance())
        covariance += np.einsum("snm,ab->snamb", tolerance, np.eye(2))
        lost = np.where(travel_m != 0.0, self.leg_sigma_m**2, 0.0)
        per_cycle = np.einsum("snl,al,bl->snab", lost, self.response_rad_per_m, self.response_rad_per_m)
        for i in range(n):
            covariance[:, i, :, i, :] += per_cycle[:, i]
        return covariance.reshape(n_stories, 2 * n, 2 * n)

    def deviation(self, travel_m: Array) -> tuple[Array, Array]:
        """Chi square (2 n degrees of freedom) and ln likelihood of each story, shapes (n_stories,).

        `travel_m` (n_stories, n, n_legs) is what the legs really made by each story; NaN gives infinity and -infinity.
        """
        known = np.all(np.isfinite(travel_m), axis=(1, 2))
        travel_m = np.where(known[:, None, None], travel_m, 0.0)
        rest = self.change_rad - travel_m @ self.response_rad_per_m.T
        chi_square, ln_likelihood = _normal(rest.reshape(len(rest), -1), self.covariance_rad2(travel_m))
        return np.where(known, chi_square, np.inf), np.where(known, ln_likelihood, -np.inf)

    def ln_likelihood_of_anything(self) -> float:
        """Ln likelihood when nothing is known of what the facet did."""
        covariance = self.noise_rad2 + np.diag(np.repeat(self.wide_rad**2, 2))
        return float(_normal(self.change_rad.reshape(1, -1), covariance[None])[1][0])

    def is_order_seen(self) -> bool:
        """Could what was ordered be told from no change at all, at four standard deviations?"""
        change = self.expected_rad.reshape(1, -1)
        return bool(
            _normal(change, self.covariance_rad2(self.travel_m[None]))[0][0] > deviation_limit(len(self.cycles))
        )


def deviation_limit(n_cycles: int) -> float:
    """Chi square of `n_cycles` changes of Theta from which on a story is refuted."""
    return float(chi2.isf(CHANCE_OF_FALSE_ALARM, 2 * n_cycles))


def theta_response(mount: Mount) -> Array:
    """Change of Theta per travel of each leg around rest, shape (2, n_legs), rad/m: 2 d(tilt) / d(travel).

    Exact for straight legs; for inclined ones to the share (travel / size of the mount), below 1 % for travels of mm.
    """
    steps = np.eye(len(mount.legs_m)) * _STEP_M
    columns = [(mount.tilt_of_travel(step) - mount.tilt_of_travel(-step)) / _STEP_M for step in steps]
    return np.stack(columns, axis=1)


def histories(
    mounts: Mapping[int, Mount],
    observations: Sequence[Observation],
    leg_sigma_m: Mapping[int, float],
    spread: float,
) -> dict[int, FacetHistory]:
    """What was seen of every facet that has a mount and, in any observation, estimates before and after.

    Parameters
    ----------
    leg_sigma_m
        Per facet: standard deviation of lost or uncertain travel of a leg that moved.
    spread
        Standard deviation of a leg's response relative to its mount's.
    """
    response = {facet_id: theta_response(mount) for facet_id, mount in mounts.items()}
    seen: dict[int, list[tuple[int, Array, Array, Array, float]]] = {}
    for i, observation in enumerate(observations):
        parts = _parts(response, observation)
        if not parts:
            continue
        rest = np.array([change - response[facet_id] @ travel for facet_id, (travel, change, _) in parts.items()])
        tolerance = [
            cov
            + (np.square(response[facet_id]) @ np.square(travel) * spread**2 + _lost(response, facet_id, leg_sigma_m))
            * np.eye(2)
            for facet_id, (travel, _, cov) in parts.items()
        ]
        shift, shift_cov = common_shift(rest, np.array(tolerance))
        usual = np.sqrt(np.mean([np.square(response[facet_id] @ travel) for facet_id, (travel, _, _) in parts.items()]))
        for facet_id, (travel, change, cov) in parts.items():
            wide = 2.0 * max(float(usual), float(np.sqrt(np.trace(cov))))
            seen.setdefault(facet_id, []).append((i, travel, change - shift, cov + shift_cov, wide))
    return {
        facet_id: FacetHistory(
            facet_id,
            tuple(row[0] for row in rows),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
            _chained_noise(facet_id, rows, observations),
            response[facet_id],
            leg_sigma_m[facet_id],
            spread,
            np.array([row[4] for row in rows]),
        )
        for facet_id, rows in sorted(seen.items())
    }


def common_shift(rest_rad: Array, cov_rad2: Array) -> tuple[Array, Array]:
    """Shift of all facets alike, shape (2,), and its covariance (2, 2), from the facets that agree on one.

    Parameters
    ----------
    rest_rad
        Shape (n_facets, 2). Change of Theta less what was ordered; facets that did something else are outliers here.
    cov_rad2
        Shape (n_facets, 2, 2).
    """
    prior = np.eye(2) / SHIFT_SIGMA_RAD**2
    centre = np.median(rest_rad, axis=0)
    weight = np.linalg.inv(cov_rad2)
    agree = np.zeros(len(rest_rad), dtype=bool)
    for _ in range(5):
        offset = rest_rad - centre
        agree = np.einsum("ja,jab,jb->j", offset, weight, offset) < chi2.isf(0.01, 2)
        if np.count_nonzero(agree) < max(_LEAST_WITNESSES, _LEAST_SHARE_OF_WITNESSES * len(rest_rad)):
            return np.zeros(2), np.eye(2) * SHIFT_SIGMA_RAD**2
        covariance = np.linalg.inv(prior + weight[agree].sum(axis=0))
        centre = covariance @ np.einsum("jab,jb->a", weight[agree], rest_rad[agree])
    return centre, covariance


def _parts(response: Mapping[int, Array], observation: Observation) -> dict[int, tuple[Array, Array, Array]]:
    """Travel, change of Theta and its covariance of every facet with both estimates and known travel."""
    parts = {}
    for facet_id in sorted(response.keys() & observation.before.keys() & observation.after.keys()):
        (theta_0, cov_0), (theta_1, cov_1) = observation.before[facet_id], observation.after[facet_id]
        own = observation.travels_m.get(facet_id)
        travel = np.zeros(response[facet_id].shape[1]) if own is None else np.asarray(own, dtype=np.float64)
        change, cov = np.asarray(theta_1) - theta_0, np.asarray(cov_0) + cov_1
        if np.all(np.isfinite(travel)) and np.all(np.isfinite(change)) and np.all(np.isfinite(cov)):
            parts[facet_id] = (travel, change, cov)
    return parts


def _lost(response: Mapping[int, Array], facet_id: int, leg_sigma_m: Mapping[int, float]) -> float:
    """Mean variance per axis of Theta by lost travel of all legs."""
    return float(leg_sigma_m[facet_id] ** 2 * np.sum(response[facet_id] ** 2) / 2.0)


def _chained_noise(
    facet_id: int, rows: Sequence[tuple[int, Array, Array, Array, float]], observations: Sequence[Observation]
) -> Array:
    """Covariance of a facet's changes; an estimate that ends one and begins the next is noise of both."""
    n = len(rows)
    noise = np.zeros((2 * n, 2 * n))
    for i, (cycle, _, _, cov, _) in enumerate(rows):
        noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = cov
        if i == 0:
            continue
        theta_then, cov_then = observations[rows[i - 1][0]].after[facet_id]
        theta_now, _ = observations[cycle].before[facet_id]
        if np.array_equal(theta_then, theta_now):
            noise[2 * i - 2 : 2 * i, 2 * i : 2 * i + 2] = -np.asarray(cov_then)
            noise[2 * i : 2 * i + 2, 2 * i - 2 : 2 * i] = -np.asarray(cov_then)
    return noise


def _normal(rest: Array, covariance: Array) -> tuple[Array, Array]:
    """Chi square and ln density of normal distributions: rest (s, d), covariance (s, d, d) -> (s,), (s,)."""
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, rest[..., None])[..., 0]
    chi_square = np.sum(white**2, axis=-1)
    ln_volume = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    return chi_square, -0.5 * chi_square - ln_volume - 0.5 * rest.shape[-1] * np.log(2.0 * np.pi)
