"""A whole campaign on a small telescope, with faults let in at the moment a test chooses.

Eight of FACT's facets on two lines, and cameras with fewer pixels: recording, reconstruction, correction and all that
decides between them are those of the program. Nothing is done to the twin that its catalogue of faults does not have.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from namod_ctl.app.build.twin_campaign import open_twin_campaign
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOutcome, StopSwitch
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, um_to_m
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import RecordSettings
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import TRANSITION, Event
from namod_ctl.twin.settings import FaultSpec, ReflectorSettings, TelescopeSettings, TwinSettings
from namod_ctl.twin.twin import Twin

SEED = 2
N_RECORDS = 150
MAX_CYCLES = 4
CORRECTION_S = 10.0
"""About how long a correction takes."""
STANDS_S = 100.0
"""So long everything must have stood still after the end."""
STEP_M, APPROACH_M = um_to_m(3.0), um_to_m(50.0)
"""Of the drives of `fact_actuated`."""
FACETS = {"south": (3, 4, 5, 10), "north": (19, 21, 22, 24)}
"""Facets on each line of the small telescope."""
N_MOVING = 6
"""Drives that may move at once on each line."""

SETTINGS = TwinSettings(
    reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(2.5)),
    telescope=TelescopeSettings(radius_rad=deg_to_rad(0.22)),
)
"""The usual twin; its facets are less astray, so that fewer records show them all."""

Hook = Callable[["CampaignRig"], None]


class HookView(View):
    """Calls a test back when the campaign gets somewhere; each hook once."""

    def __init__(self) -> None:
        self.rig: CampaignRig | None = None
        self.on_state: dict[str, Hook] = {}
        self.on_trouble: Hook | None = None

    def state(self, state: str, reason: str) -> None:
        self._call(self.on_state.pop(state, None))

    def recording(self, cycle: int, progress: Progress) -> None:
        if progress.trouble:
            hook, self.on_trouble = self.on_trouble, None
            self._call(hook)

    def _call(self, hook: Hook | None) -> None:
        if hook is not None:
            assert self.rig is not None
            hook(self.rig)


class LateSwitch(StopSwitch):
    """Is thrown, once it is armed, as soon as that many drives move: people press buttons when they see motion."""

    def __init__(self) -> None:
        super().__init__()
        self.n_moving = math.inf
        self.thrown_s = math.nan
        self.twin: Twin | None = None

    @property
    def is_thrown(self) -> bool:
        if self.twin is not None and math.isfinite(self.n_moving) and not super().is_thrown:
            drives = self.twin.drives
            if sum(drives.motor(leg).is_moving for leg in drives.legs) >= self.n_moving:
                self.thrown_s = self.twin.clock.monotonic_s()
                self.throw("somebody pressed stop")
        return super().is_thrown


@dataclass
class CampaignRig:
    """An open campaign, its twin, and what the test saw."""

    store: CampaignStore
    campaign: Campaign
    twin: Twin
    view: HookView
    switch: LateSwitch
    before_rad2: float

    def run(self) -> str:
        return self.campaign.run()

    @property
    def area_rad2(self) -> float:
        """The true area of the point spread function at this moment."""
        self.twin.update(self.twin.clock.monotonic_s())
        return self.twin.reflector.a_sigma_now_rad2()

    @property
    def ratio_to_limit(self) -> float:
        return self.area_rad2 / self.twin.reflector.a_sigma_aligned_rad2()

    def events(self, kind: str) -> list[Event]:
        return [event for event in self.store.events() if event.kind == kind]

    def findings(self) -> str:
        return "\n".join(event.text for event in self.events("finding"))

    def refused(self) -> dict[int, str]:
        """Facets that any correction of this campaign refused, and why."""
        return {int(str(event.data["facet_id"])): str(event.data["why"]) for event in self.events("refused")}

    def path(self) -> list[str]:
        """Names of all states that the campaign went through."""
        return [str(event.data["to"]) for event in self.events(TRANSITION)]

    def reason(self) -> str:
        """Why it is where it is."""
        return str(self.events(TRANSITION)[-1].data["reason"])

    def outcomes(self, cycle: int | None = None) -> dict[MoveOutcome, set[Leg]]:
        found: dict[MoveOutcome, set[Leg]] = {}
        for journaled in self.store.orders(cycle):
            assert journaled.result is not None, journaled
            found.setdefault(journaled.result.outcome, set()).add(journaled.order.leg)
        return found

    def inject(
        self, name: str, params: Mapping[str, float | str], *, in_s: float = 0.0, for_s: float | None = None
    ) -> None:
        self.twin.drives.inject(FaultSpec(name, self.twin.clock.monotonic_s() + in_s, for_s, params))

    def assert_safe(self) -> None:
        """What holds at the end of every campaign, whatever befell it: by the twin's truth and its drives' own log."""
        assert self.area_rad2 <= self.before_rad2 * 1.02  # 2 %: facets sag a little with time
        assert all(journaled.result is not None for journaled in self.store.orders())
        self.assert_stands()

    def assert_stands(self) -> None:
        """Nothing moves any more, nor later."""
        drives = self.twin.drives
        before_m = {leg: drives.travel_m(leg) for leg in drives.legs}
        self.twin.clock.wait_s(STANDS_S)
        self.twin.update(self.twin.clock.monotonic_s())
        assert {leg: drives.travel_m(leg) for leg in drives.legs} == before_m

    def assert_only_ordered_moves(self) -> None:
        """No drive was sent anywhere but to a target on record, or a little below it to come from one side."""
        targets_m: dict[Leg, list[float]] = {}
        for journaled in self.store.orders():
            targets_m.setdefault(journaled.order.leg, []).append(journaled.order.target_m)
        for entry in self.twin.drives.log:
            if entry.order == "move":
                away_m = [target_m - entry.end_m for target_m in targets_m.get(entry.leg, [])]
                assert any(-STEP_M <= one_m <= APPROACH_M + STEP_M for one_m in away_m), entry


def small_config(name: str = "fact_actuated", *, in_memory: bool = True) -> InstrumentConfig:
    """A built-in config of FACT with four facets on each of two lines, and smaller pictures of the same fields."""
    config = load_config(name)
    assert config.actuators is not None
    buses = tuple(
        bus.model_copy(
            update={"facet_ids": facets, "max_moving": N_MOVING, "name": line}
            | ({"url": f"loopback://{line}"} if in_memory else {})
        )
        for bus, (line, facets) in zip(config.actuators.buses[:2], FACETS.items(), strict=True)
    )
    ids = {facet_id for facets in FACETS.values() for facet_id in facets}
    facets = tuple(facet for facet in config.facets if facet.id in ids)
    star_camera = {"columns": 640, "rows": 480, "axis_px": (320.0, 240.0)}
    return config.model_copy(
        update={
            "actuators": config.actuators.model_copy(update={"buses": buses}),
            "reflector": config.reflector.model_copy(update={"facets": facets}),
            "reflector_map": None,
            "star_camera": config.star_camera.model_copy(update=star_camera),
            "reflector_camera": config.reflector_camera.model_copy(update={"columns": 384, "rows": 288}),
        }
    )


@contextmanager
def campaign_rig(
    path: Path,
    *,
    in_memory: bool = True,
    name: str = "fact_actuated",
    settings: TwinSettings = SETTINGS,
) -> Iterator[CampaignRig]:
    """A campaign at `path`, new or taken up where it stands, on its twin."""
    config = small_config(name, in_memory=in_memory)
    view, switch = HookView(), LateSwitch()
    wishes = CampaignSettings(RecordSettings(store_retry_s=0.01), N_RECORDS, MAX_CYCLES)
    with ExitStack() as stack:
        if path.exists():
            store = CampaignStore.open(path, read_only=False)
        else:
            store = CampaignStore.create(path, config.to_json(), "small twin of FACT", SystemClock())
        stack.enter_context(store)
        opened = stack.enter_context(
            open_twin_campaign(store, config, settings, SEED, wishes, SystemClock(), switch, view)
        )
        twin = opened.twin
        _wait_for_next_pass(twin)
        rig = CampaignRig(store, opened.campaign, twin, view, switch, math.nan)
        rig.before_rad2 = rig.area_rad2
        view.rig, switch.twin = rig, twin
        yield rig


def _wait_for_next_pass(twin: Twin) -> None:
    """A campaign is taken up a minute later: let the telescope begin anew, or its path leaves the middle out."""
    pass_s, now_s = twin.telescope.pass_s, twin.clock.monotonic_s()
    if now_s > 0.0:
        twin.update(math.ceil((now_s + CORRECTION_S) / pass_s) * pass_s - CORRECTION_S)


def recorded_campaign(path: Path) -> Path:
    """A campaign of the usual twin that has recorded its first cycle and is about to show what it would do."""

    def snapshot(rig: CampaignRig) -> None:
        shutil.copytree(rig.store.path, path)
        rig.switch.throw("this was all that was wanted")

    with campaign_rig(path.with_name(f"{path.name}_first")) as rig:
        rig.view.on_state["previewing"] = snapshot
        assert rig.run() == "held"
    return path
