"""What the corrections of a campaign have taught about its drives, and the travels that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from namod_ctl.core.drives import Leg
from namod_ctl.cycle.common_gain import common_gain
from namod_ctl.cycle.evidence import Observation
from namod_ctl.cycle.learn import FaultKind, diagnose, observed
from namod_ctl.cycle.remedy import Remedy, remedy_of
from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment

_NEWS_SHARE = 0.05
"""A common gain that changes by less is known better, but no news."""


class LearnedWiring:
    """Findings of all corrections of a campaign together, and the drives as they are really wired."""

    def __init__(self, mounts: Mapping[int, Mount], resolution_m: float) -> None:
        self._mounts, self._resolution_m = mounts, resolution_m
        self._remedy = Remedy(mounts, {}, {}, {})
        self._known: dict[int, FaultKind] = {}
        self._gain = 1.0
        self.has_news = False
        """Did the last call of `learn` find a fault that the one before had not?"""

    @property
    def disabled(self) -> Mapping[int, str]:
        """Facets that must not be corrected, and why."""
        return self._remedy.disabled

    def learn(self, travels_m: Mapping[int, Mapping[Leg, float]], alignments: Mapping[int, Alignment]) -> list[str]:
        """Faults that were not known before, a sentence each.

        Parameters
        ----------
        travels_m
            By cycle: how far each drive went after that cycle's recording.
        alignments
            By cycle: what was seen in its recording.
        """
        observations = observations_of(self._mounts, travels_m, alignments)
        if not observations:
            return []
        gain = common_gain(observed(self._mounts, observations, self._resolution_m))
        observations = [_scaled(observation, gain) for observation in observations]
        findings = diagnose(self._mounts, observations, resolution_m=self._resolution_m)
        self._remedy = remedy_of(self._mounts, observations, findings, resolution_m=self._resolution_m)
        faults = [finding for finding in findings if finding.kind.is_fault]
        news = [finding.sentence for finding in faults if self._known.get(finding.facet_id) != finding.kind]
        if abs(gain - self._gain) > _NEWS_SHARE * abs(gain):
            news.insert(0, _in_words(gain))
            self._gain = gain
        self._known = {finding.facet_id: finding.kind for finding in faults}
        self.has_news = bool(news)
        return news

    def travels(self, facet: FacetAlignment) -> Mapping[Leg, float]:
        """Travel, m, of every drive that turns the facet as it needs; none for a facet that must not be corrected."""
        travels = self._remedy.travel_for(facet.facet_id, facet.tilt_correction_rad)
        return {leg: travel / self._gain for leg, travel in travels.items()}

    def trials(self) -> dict[int, dict[Leg, float]]:
        """By facet that nobody understands yet: small travels, m, that will tell what is wrong with it."""
        return {
            facet_id: {Leg(facet_id, k): float(travel) / self._gain for k, travel in enumerate(travels)}
            for facet_id, travels in self._remedy.trials_m.items()
        }


def _scaled(observation: Observation, gain: float) -> Observation:
    """The observation with travels as they really were."""
    return replace(observation, travels_m={facet: gain * travel for facet, travel in observation.travels_m.items()})


def _in_words(gain: float) -> str:
    if gain == 1.0:
        return "all legs move as the config says after all"
    if gain == -1.0:
        return "all legs move the wrong way: sign in the config's [actuators] is wrong; it is reckoned with from now on"
    return (
        f"all legs move by a factor {gain:.3g} of what was ordered: step_um in the config's [actuators] or the pitch "
        "is wrong, or the supply is too weak for max_moving drives at once; it is reckoned with from now on"
    )


def observations_of(
    mounts: Mapping[int, Mount], travels_m: Mapping[int, Mapping[Leg, float]], alignments: Mapping[int, Alignment]
) -> list[Observation]:
    """Corrections between two recordings that both have an alignment, in their order."""
    estimates = {
        cycle: {facet.facet_id: (facet.theta_rad, facet.theta_cov_rad2) for facet in alignment.facets}
        for cycle, alignment in alignments.items()
    }
    observations = []
    for number, moved in sorted(travels_m.items()):
        if number in estimates and number + 1 in estimates:
            by_facet = {
                facet_id: np.array([moved.get(Leg(facet_id, k), 0.0) for k in range(len(mounts[facet_id].legs_m))])
                for facet_id in {leg.facet_id for leg in moved}
            }
            observations.append(Observation(by_facet, estimates[number], estimates[number + 1]))
    return observations
