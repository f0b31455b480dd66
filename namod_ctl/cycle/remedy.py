"""What to do about what was learned: which drive to order how far for a tilt, which facets to leave alone, what to try.

Nothing is changed in the config; the remedy lives with the campaign, and says to a person what to mend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.drives import Leg
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.cycle.evidence import FacetHistory, Observation, deviation_limit
from namod_ctl.cycle.learn import FaultKind, Finding, observed
from namod_ctl.cycle.stories import Story
from namod_ctl.optics.mounts import Mount

Array = NDArray[np.float64]

# A trial move changes Theta by this per leg if the leg does as told, less than the misalignments that are corrected;
# by more only where that is not as many times the noise of a change.
_TRIAL_RAD = arcmin_to_rad(3.0)
_TRIAL_PER_NOISE = 10.0
_MOVES_BY_DRIVES = (FaultKind.LEG_REVERSED, FaultKind.LEGS_SWAPPED, FaultKind.WRONG_SCALE, FaultKind.FOREIGN_DRIVE)


@dataclass(frozen=True, slots=True, eq=False)
class LegMap:
    """How a facet's legs are really driven.

    Attributes
    ----------
    drives
        For each leg: the leg under which the config knows the drive that moves it.
    gains
        Shape (n_legs,). Travel of the leg per travel of that drive.
    tilt_per_travel_rad_per_m
        Shape (2, n_legs). Learned response of the facet's normal to its legs; None: the mount's own is good enough.
    """

    drives: tuple[Leg, ...]
    gains: Array
    tilt_per_travel_rad_per_m: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Remedy:
    """What later corrections make of the findings.

    Attributes
    ----------
    maps
        Facets whose legs are driven otherwise than the config or the mount says.
    disabled
        Facets that must not be moved, and why (the finding's sentence).
    trials_m
        Of the disabled facets those that two or more stories explain: the travel per drive, shape (n_legs,), that
        tells the stories apart best. Once it was made and seen, `diagnose` may know more.
    """

    mounts: Mapping[int, Mount]
    maps: Mapping[int, LegMap]
    disabled: Mapping[int, str]
    trials_m: Mapping[int, Array]

    def travel_for(self, facet_id: int, tilt_rad: Array) -> dict[Leg, float]:
        """Travel in m of each drive, by its name in the config, that turns the facet's normal by `tilt_rad` (2,).

        Empty for a disabled facet. The drives may be those of another facet; limits are the drives' own.
        """
        if facet_id in self.disabled:
            return {}
        mount = self.mounts[facet_id]
        travel = mount.travel_of_tilt(tilt_rad)
        own = LegMap(tuple(Leg(facet_id, k) for k in range(len(travel))), np.ones(len(travel)))
        leg_map = self.maps.get(facet_id, own)
        response = leg_map.tilt_per_travel_rad_per_m
        if response is not None:
            # The least change of the nominal travels that makes the learned response give the tilt.
            travel = travel + np.linalg.pinv(response) @ (np.asarray(tilt_rad) - response @ travel)
        return {
            drive: float(one / gain) for drive, one, gain in zip(leg_map.drives, travel, leg_map.gains, strict=True)
        }


def remedy_of(
    mounts: Mapping[int, Mount],
    observations: Sequence[Observation],
    findings: Sequence[Finding],
    *,
    resolution_m: float = 0.0,
) -> Remedy:
    """The remedy of `findings`, which `diagnose` made of the same observations.

    Drives crossed between facets are used only when the story of the other facet is known too: a drive has one master.
    """
    seen = observed(mounts, observations, resolution_m)
    maps: dict[int, LegMap] = {}
    disabled: dict[int, str] = {}
    trials: dict[int, Array] = {}
    for finding in findings:
        facet_id, story = finding.facet_id, finding.story
        if story is None or (finding.kind.is_fault and finding.kind not in _MOVES_BY_DRIVES):
            disabled[facet_id] = finding.sentence
            if len(finding.rivals) > 0:
                trials[facet_id] = _trial(seen[facet_id], finding.rivals, observations)
            continue
        response = learned_response(seen[facet_id], story, observations)
        if finding.kind.is_fault or response is not None:
            maps[facet_id] = LegMap(
                story.sources, np.array(story.final_gains), None if response is None else response / 2.0
            )
    for facet_id in [one for one in maps if not {drive.facet_id for drive in maps[one].drives}.isdisjoint(disabled)]:
        del maps[facet_id]
        disabled[facet_id] = f"facet {facet_id} is moved by drives of a facet of which nobody knows what moves it"
    return Remedy(mounts, maps, disabled, trials)


def learned_response(history: FacetHistory, story: Story, observations: Sequence[Observation]) -> Array | None:
    """Change of Theta per travel of each leg, shape (2, n_legs), rad/m; None while the nominal one is good enough.

    The mount's response is the mean of the prior, `history.spread` its standard deviation per leg and axis; all
    observations, with travels as they were by `story`, update it. It is used when the nominal response is refuted by
    them at four standard deviations.
    """
    travel = story.travel_m(history, observations)
    nominal = history.response_rad_per_m
    noise = history.covariance_rad2(travel[None])[0] - _response_covariance(history, travel)
    rest = (history.change_rad - travel @ nominal.T).reshape(-1)
    if rest @ np.linalg.solve(noise, rest) <= deviation_limit(len(history.cycles)):
        return None
    # Components of the response are ordered (axis, leg).
    design = np.einsum("nl,ab->nabl", travel, np.eye(2)).reshape(rest.size, nominal.size)
    prior = np.diag(np.tile(history.response_variance(), 2))
    gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + noise)
    learned: Array = nominal + (gain @ rest).reshape(nominal.shape)
    return learned


def _response_covariance(history: FacetHistory, travel_m: Array) -> Array:
    """Part of the covariance that is the tolerance of the response, shape (2 n, 2 n)."""
    return np.kron(np.einsum("nl,ml,l->nm", travel_m, travel_m, history.response_variance()), np.eye(2))


def _trial(history: FacetHistory, rivals: Sequence[Story], observations: Sequence[Observation]) -> Array:
    """Travel of the facet's drives, one or two of them, under which the rivals' predictions differ most.

    Of its two senses the one is taken that the most probable rival says brings the facet nearer to where it was
    before all corrections, so that trials do not add up.
    """
    n = history.travel_m.shape[1]
    noise_rad = float(np.sqrt(np.mean(np.diag(history.noise_rad2))))
    size = max(_TRIAL_RAD, _TRIAL_PER_NOISE * noise_rad) / float(
        np.max(np.linalg.norm(history.response_rad_per_m, axis=0))
    )
    single = np.eye(n)
    both = [single[i] - single[j] for i in range(n) for j in range(i)]
    candidates = size * np.vstack([single, both])
    predicted = np.array([[_made(history, story, one) for story in rivals] for one in candidates])
    nothing = np.zeros((len(candidates), 1, 2))
    predicted = np.concatenate([predicted, nothing], axis=1) if len(rivals) == 1 else predicted
    gap = np.linalg.norm(predicted[:, :, None] - predicted[:, None, :], axis=-1)
    gap += np.where(np.eye(gap.shape[1], dtype=bool), np.inf, 0.0)
    best = int(np.argmax(gap.min(axis=(1, 2))))
    made = predicted[best, 0]
    trial: Array = candidates[best] * (-1.0 if float(made @ history.change_rad.sum(axis=0)) > 0.0 else 1.0)
    return trial


def _made(history: FacetHistory, story: Story, travel_m: Array) -> Array:
    """Change of Theta (2,) that a travel of this facet's own drives makes by a story."""
    made = [
        gain * travel_m[source.index] if source.facet_id == history.facet_id else 0.0
        for source, gain in zip(story.sources, story.final_gains, strict=True)
    ]
    change: Array = history.response_rad_per_m @ np.array(made)
    return change
