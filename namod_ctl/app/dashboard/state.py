"""What the page shows, read from the disk and from nowhere else: a run or a campaign, in sections that change apart.

Everything here is for one thread, the feed's. Nothing here writes, and nothing holds a device.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from namod_ctl import __version__
from namod_ctl.app.alignment_files import alignment_from_json
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.dashboard import campaign_sections, facet_sections, preview
from namod_ctl.app.dashboard.run_sections import RunGlance, estimate_of
from namod_ctl.core.errors import ConfigError, NamodError, StoreError
from namod_ctl.core.units import um_to_m
from namod_ctl.cycle.recording_control import pid_at_work
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME, connect_campaign, is_campaign
from namod_ctl.store.campaign_rows import Cycle
from namod_ctl.store.database import DATABASE_NAME, store_errors
from namod_ctl.store.folders import is_run
from namod_ctl.store.pulse import Pulse
from namod_ctl.store.run import RunStore

NO_CAMPAIGN: Final = 0
"""Key of a run that belongs to no campaign."""

LOCK_EVERY_S = 0.5
"""Whether somebody is at work is looked at so often: the lock leaves no trace in a database."""

AT_REST_AFTER_S = 20.0
"""A plain run that was not written for so long is shown as one that rests: 6 of the longest exposures."""

ROUGH_EVERY_S = 1.0

ROUGH = "the records so far, roughly: by the direction in which each facet was brightest"
"""Where the page's figures of the facets come from before there is an estimate."""

Sections = dict[str, str]
"""JSON text of each section by its name."""


class Watched:
    """A run or a campaign that is looked at; a context manager.

    Raises
    ------
    ConfigError
        There is neither at `path`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        self.is_campaign = is_campaign(self.path)
        self._campaign = CampaignStore.open(self.path) if self.is_campaign else None
        if self._campaign is None and not is_run(self.path):
            raise ConfigError(f"{path}: is neither a run nor a campaign; name the folder of one")
        self._database = self.path / (CAMPAIGN_DATABASE_NAME if self.is_campaign else DATABASE_NAME)
        with store_errors(self._database):
            self._stat = self._database.stat()
        config_json, self._source = self._config_and_source()
        config = InstrumentConfig.from_json(config_json, f"{path}: config")
        self._config = config
        self.instrument: Instrument = facet_sections.instrument_of(config)
        self._glance: RunGlance | None = None
        self._awaited_run: int | None = None  # a cycle is begun before its run is there, and nothing tells of that
        self._sent: Sections = {}
        self._alignments: dict[int, tuple[int, Alignment]] = {}
        self._preview: tuple[int, dict[str, Any] | None] = (0, None)  # of which step of the journal
        self._pulse: Pulse | None = None
        if self.is_campaign:
            self._pulse = Pulse(connect_campaign(self._database, read_only=True), self._database)
        self._looked_at_lock_s = -1.0
        self._pid: int | None = None
        self._estimate_id = -1
        self._has_estimate = self._owes_rough = self._was_listening = False
        self._rough_s = -math.inf

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the databases."""
        if self._glance is not None:
            self._glance.close()
        if self._campaign is not None:
            self._campaign.close()
        if self._pulse is not None:
            self._pulse.close()

    def look(self) -> Sections:
        """Sections that are new or differ from the last look; empty when nothing has happened."""
        found: dict[str, Any] = {}
        try:
            if not self._sent:
                found["about"] = self._about()
            self._check_in_place()
            self._look_at_campaign(found)
            self._look_at_run(found)
            found["trouble"] = ""
        except NamodError as error:  # a disk that went away may come back; the page says so and goes on
            found["trouble"] = str(error)
            self._begin_anew()
        changed = {}
        for name, value in found.items():
            text = json.dumps(value, allow_nan=False, separators=(",", ":"))
            if self._sent.get(name) != text:
                changed[name] = text
        self._sent |= changed
        return changed

    def everything(self) -> Sections:
        """All sections as they were at the last look."""
        return dict(self._sent)

    def run_path(self, key: int) -> Path | None:
        """Folder of the run of that key, None when there is none."""
        if self._campaign is None:
            return self.path if key == NO_CAMPAIGN else None
        path = self._campaign.run_path(key)
        return path if is_run(path) else None

    def facet(self, facet_id: int) -> dict[str, Any] | None:
        """Its light over directions, in the run that is looked at; None for a facet that there is not."""
        if facet_id not in self.instrument.reflector.ids:
            return None
        glance = self._glance
        return {
            "id": facet_id,
            "run": glance.key if glance else None,
            "samples": glance.samples(facet_id) if glance else [],
        }

    def sheet(self, key: int) -> dict[str, Any] | None:
        """Which bolts are turned after a cycle, or the run (`NO_CAMPAIGN`), and how; None without such a sheet."""
        # brings matplotlib, which takes a second, and no page but one with sheets needs it
        from namod_ctl.app.dashboard.work_sheet import work_sheet

        try:
            if self._campaign is None:
                text = estimate_of(self.path) if key == NO_CAMPAIGN else None
                return work_sheet(self.instrument, alignment_from_json(text, str(self.path)), []) if text else None
            known = self._alignments.get(key)
            turns = self._campaign.turns(key) if known else []
        except StoreError:  # a disk that went away: the next look says so
            return None
        done = [turn.facet_id for turn in turns if turn.is_done]
        return work_sheet(self.instrument, known[1], done) if known and turns else None

    def step(self) -> int:
        """Number of the journal's last step of the campaign's machine, 0 without one.

        Raises StoreError when another campaign is there: what is seen of this one says nothing about that.
        """
        self._check_in_place()
        transition = self._campaign.last_transition() if self._campaign else None
        return transition.id if transition else 0

    def _config_and_source(self) -> tuple[str, str]:
        if self._campaign is not None:
            return self._campaign.config_json, self._campaign.source
        with RunStore.open(self.path) as run:
            return run.config_json, run.source

    def _about(self) -> dict[str, Any]:
        return facet_sections.geometry(self.instrument) | {
            "kind": "campaign" if self.is_campaign else "run",
            "name": self.path.name,
            "source": self._source,
            "version": __version__,
        }

    def _check_in_place(self) -> None:
        """Nothing, while the database is the one that was opened: SQLite would go on reading one that was deleted.

        Raises
        ------
        StoreError
            It is gone, or another is there.
        """
        with store_errors(self._database):
            now = self._database.stat()
        if not os.path.samestat(now, self._stat):
            raise StoreError(f"{self.path}: was replaced by another one; start the dashboard anew")

    def _look_at_campaign(self, found: dict[str, Any]) -> None:
        store, pulse = self._campaign, self._pulse
        if store is None or pulse is None:
            return
        is_other_process = self._looks_at_lock()
        if self._awaited_run is not None and is_run(store.run_path(self._awaited_run)):
            self._follow(store.run_path(self._awaited_run), self._awaited_run)
            self._awaited_run = None
        if not pulse.has_changed() and not is_other_process:
            return
        cycles = store.cycles()
        alignments = campaign_sections.alignments_of(cycles, self._alignments)
        found["standing"] = campaign_sections.standing(store, self._pid)
        found["cycles"] = campaign_sections.cycle_table(cycles)
        found["actuators"] = campaign_sections.actuators(store)
        found["preview"] = self._preview_of(store, cycles, alignments)
        found["journal"] = campaign_sections.journal(store.events())
        found["sheets"] = campaign_sections.sheets(store, cycles)
        self._has_estimate = bool(alignments)
        if alignments:
            number = max(alignments)
            cycle = next(cycle for cycle in cycles if cycle.number == number)
            found["facets"] = _facets(alignments[number], f"cycle {number}", alignments)
            found["psf"] = facet_sections.whole_psf(
                alignments[number], cycle.a_sigma_predicted_rad2, cycle.a_sigma_limit_rad2
            )
        runs = [cycle.number for cycle in cycles if is_run(store.run_path(cycle.number))]
        self._awaited_run = next((cycle.number for cycle in cycles[-1:] if cycle.number not in runs), None)
        if runs and (self._glance is None or self._glance.key != runs[-1]):
            self._follow(store.run_path(runs[-1]), runs[-1])

    def _preview_of(
        self, store: CampaignStore, cycles: list[Cycle], alignments: Mapping[int, Alignment]
    ) -> dict[str, Any] | None:
        """What waits for approval, None while nothing does; worked out once per question."""
        step = store.last_transition()
        if step is None or step.data.get("to") != preview.ASKING or not cycles or cycles[-1].number not in alignments:
            return None
        if self._preview[0] != step.id:
            refused = preview.refused_in(store.events())
            actuators = self._config.actuators
            resolution_m = um_to_m(actuators.step_um) if actuators and actuators.step_um else 0.0
            travels_m = preview.planned_travels(
                self.instrument.mounts, alignments, store.orders(), refused, resolution_m
            )
            question = str(step.data.get("reason", ""))
            self._preview = (step.id, preview.preview(cycles[-1], question, refused, travels_m))
        return self._preview[1]

    def _look_at_run(self, found: dict[str, Any]) -> None:
        if self._campaign is None and self._glance is None:
            self._follow(self.path, NO_CAMPAIGN)
        glance = self._glance
        if glance is None:
            return
        is_changed = glance.update()
        if is_changed:
            found["now"] = glance.now()
        if self._campaign is None:
            self._stand_of_run(found, glance, is_changed=is_changed)
        if not self._has_estimate and (is_changed or self._owes_rough):
            self._look_roughly(found, glance)

    def _stand_of_run(self, found: dict[str, Any], glance: RunGlance, *, is_changed: bool) -> None:
        """What a campaign would say of itself has to be guessed for a run: it is being recorded while it grows."""
        self._looks_at_lock()
        self._was_listening |= self._pid is not None
        # one that takes requests to stop is over when it takes none any more; of others only the silence tells
        is_growing = self._pid is not None or (not self._was_listening and glance.silent_s() < AT_REST_AFTER_S)
        found["standing"] = _run_standing(is_growing=is_growing, is_listening=self._pid is not None)
        if is_changed and (number := glance.estimate_id()) != self._estimate_id:
            self._estimate_id = number
            text = estimate_of(self.path)
            if text is not None:
                alignment = alignment_from_json(text, str(self.path))
                self._has_estimate = True
                found["facets"] = _facets(alignment, "this run", {})
                found["psf"] = facet_sections.whole_psf(alignment, alignment.predicted.a_sigma_rad2, math.nan)
                if any(len(facet.bolt_turn_deg) for facet in alignment.facets):
                    found["sheets"] = [{"key": NO_CAMPAIGN, "fingerprint": number}]

    def _look_roughly(self, found: dict[str, Any], glance: RunGlance) -> None:
        """Facets as their brightest records show them, now and then: the first estimate comes after the recording."""
        now_s = time.monotonic()
        self._owes_rough = now_s - self._rough_s < ROUGH_EVERY_S
        if not self._owes_rough:
            self._rough_s = now_s
            table = facet_sections.rough_table(self.instrument, glance.rough_centres_rad())
            found["facets"] = {"of": ROUGH, "table": table}

    def _begin_anew(self) -> None:
        """Read everything at the next look: what was under way when it failed is not known."""
        if self._glance is not None:
            with suppress(StoreError):
                self._glance.close()
            self._glance = None
        if self._pulse is not None:
            self._pulse.forget()

    def _follow(self, path: Path, key: int) -> None:
        if self._glance is not None:
            self._glance.close()
            self._glance = None
        self._glance = RunGlance(path, self._config, self.instrument, key)

    def _looks_at_lock(self) -> bool:
        """Has it changed who is at work? Looked at now and then only."""
        now_s = time.monotonic()
        if now_s - self._looked_at_lock_s < LOCK_EVERY_S:
            return False
        self._looked_at_lock_s = now_s
        before = self._pid
        with suppress(StoreError):
            self._pid = pid_at_work(self.path)
        return self._pid != before


def _facets(alignment: Alignment, of: str, history: Mapping[int, Alignment]) -> dict[str, Any]:
    return {"of": of, "table": facet_sections.facet_table(alignment, history)}


def _run_standing(*, is_growing: bool, is_listening: bool) -> dict[str, Any]:
    return {
        "kind": "run",
        "state": "recording" if is_growing else "at rest",
        "meaning": "records come in" if is_growing else "nothing has been written lately: it has ended or waits",
        "reason": "",
        "is_running": is_growing,
        "next": "it goes on by itself"
        if is_growing
        else "'namod-ctl reconstruct' works out the facets; 'namod-ctl instruct' writes sheets for the bolts",
        "step": 0,
        "commands": ["stop"] if is_listening else [],
        "refused": [],
        "turns_of": None,
        "turns": [],
    }
