"""What a campaign is given: the crew's wishes, what it needs from above, and somebody to show things to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from namod_ctl.cycle.plan import Plan
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.psf_check import OpenPsfEquipment
from namod_ctl.cycle.record import Equipment, RecordSettings
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign_rows import Cycle


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """What the crew may choose.

    Attributes
    ----------
    n_records
        Records per cycle.
    max_cycles
        Corrections at most.
    is_asked
        A person approves every correction before anything moves.
    limit_rad2
        A_sigma of these very mirrors perfectly aligned, where it is known.
    """

    record: RecordSettings
    n_records: int = 400
    max_cycles: int = 5
    is_asked: bool = False
    limit_rad2: float | None = None


class View:
    """What the crew sees; this one shows nothing."""

    def state(self, state: str, reason: str) -> None:
        """The campaign is in that state now."""

    def recording(self, cycle: int, progress: Progress) -> None:
        """Records are coming in."""

    def measured(self, cycle: Cycle, result: Reconstruction) -> None:
        """A cycle's point spread function is known."""

    def plan(self, plan: Plan) -> None:
        """What is about to be done."""

    def told(self, text: str) -> None:
        """Something that a person should know."""

    def answer(self) -> bool | None:
        """Whether the person at the terminal approves of the plan shown last; None: no answer yet."""
        return None

    def turned(self) -> Sequence[int] | Literal["all"]:
        """Facets that the person at the terminal says are turned as asked; empty: no answer yet."""
        return ()

    def wait(self) -> None:
        """Wait a moment for a person, or for a request from elsewhere."""


@dataclass(frozen=True, slots=True)
class Outside:
    """What the campaign needs from above it.

    Attributes
    ----------
    equipment
        Opens the cameras, anew for each recording.
    alignment_to_json, alignment_from_json
        The machine-readable form of an alignment; reading takes the name of the source as well.
    write_results
        Writes tables and pictures of a reconstruction into its run's folder.
    psf_equipment
        Opens the PSF camera, anew for each look; None where there is none.
    """

    equipment: Callable[[], Equipment]
    alignment_to_json: Callable[[Alignment], str]
    alignment_from_json: Callable[[str, str], Alignment]
    write_results: Callable[[Path, Reconstruction], None]
    psf_equipment: OpenPsfEquipment | None = None
