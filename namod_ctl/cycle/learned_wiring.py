"""What the corrections of a campaign have taught about its drives, and the travels that follow from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from namod_ctl.core.drives import Leg
from namod_ctl.cycle.evidence import Observation
from namod_ctl.cycle.learn import FaultKind, diagnose
from namod_ctl.cycle.remedy import Remedy, remedy_of
from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment


class LearnedWiring:
    """Findings of all corrections of a campaign together, and the drives as they are really wired."""

    def __init__(self, mounts: Mapping[int, Mount], resolution_m: float) -> None:
        self._mounts, self._resolution_m = mounts, resolution_m
        self._remedy = Remedy(mounts, {}, {}, {})
        self._known: dict[int, FaultKind] = {}
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
        findings = diagnose(self._mounts, observations, resolution_m=self._resolution_m)
        self._remedy = remedy_of(self._mounts, observations, findings, resolution_m=self._resolution_m)
        faults = [finding for finding in findings if finding.kind.is_fault]
        news = [finding for finding in faults if self._known.get(finding.facet_id) != finding.kind]
        self._known = {finding.facet_id: finding.kind for finding in faults}
        self.has_news = bool(news)
        return [finding.sentence for finding in news]

    def travels(self, facet: FacetAlignment) -> Mapping[Leg, float]:
        """Travel, m, of every drive that turns the facet as it needs; none for a facet that must not be corrected."""
        return self._remedy.travel_for(facet.facet_id, facet.tilt_correction_rad)

    def trials(self) -> dict[int, dict[Leg, float]]:
        """By facet that nobody understands yet: small travels, m, that will tell what is wrong with it."""
        return {
            facet_id: {Leg(facet_id, k): float(travel) for k, travel in enumerate(travels)}
            for facet_id, travels in self._remedy.trials_m.items()
        }


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
