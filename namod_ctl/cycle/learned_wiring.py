"""What the corrections of a campaign have taught about its drives, and the travels that follow from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from namod_ctl.core.drives import Leg
from namod_ctl.cycle.evidence import Observation
from namod_ctl.cycle.learn import Finding, diagnose
from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment


class LearnedWiring:
    """Findings of all corrections together; travels for the drives as they are really wired."""

    def __init__(self, mounts: Mapping[int, Mount], resolution_m: float) -> None:
        self._mounts, self._resolution_m = mounts, resolution_m
        self._findings: dict[int, Finding] = {}

    @property
    def has_changed(self) -> bool:
        """Did the last call of `learn` find anything that the one before had not?"""
        return any(finding.kind.is_fault for finding in self._findings.values())

    @property
    def disabled(self) -> dict[int, str]:
        """Facets that must not be moved, and why."""
        return {}

    def learn(self, travels_m: Mapping[int, Mapping[Leg, float]], alignments: Mapping[int, Alignment]) -> list[str]:
        """New findings, a sentence each.

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
        found = diagnose(self._mounts, observations, resolution_m=self._resolution_m)
        news = [
            finding
            for finding in found
            if finding.kind.is_fault
            and (finding.facet_id not in self._findings or self._findings[finding.facet_id].kind != finding.kind)
        ]
        self._findings = {finding.facet_id: finding for finding in found if finding.kind.is_fault}
        return [finding.sentence for finding in news]

    def travels(self, facet: FacetAlignment) -> dict[Leg, float]:
        """Travel, m, of every drive that turns the facet as it needs."""
        return {Leg(facet.facet_id, k): float(travel) for k, travel in enumerate(facet.leg_travel_m)}


def observations_of(
    mounts: Mapping[int, Mount], travels_m: Mapping[int, Mapping[Leg, float]], alignments: Mapping[int, Alignment]
) -> list[Observation]:
    """Corrections between two recordings that both have an alignment, in their order."""
    observations = []
    for number, moved in sorted(travels_m.items()):
        if number not in alignments or number + 1 not in alignments:
            continue
        by_facet = {
            facet_id: np.array([moved.get(Leg(facet_id, k), 0.0) for k in range(len(mounts[facet_id].legs_m))])
            for facet_id in {leg.facet_id for leg in moved}
        }
        before, after = (
            {facet.facet_id: (facet.theta_rad, facet.theta_cov_rad2) for facet in alignments[cycle].facets}
            for cycle in (number, number + 1)
        )
        observations.append(Observation(by_facet, before, after))
    return observations
