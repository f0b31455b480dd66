"""A campaign on the digital twin: everything that works together, opened in order and closed in the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from namod_ctl.app.alignment_files import alignment_files, alignment_from_json, alignment_to_json
from namod_ctl.app.build_actuators import build_motion_settings
from namod_ctl.app.build_recording import build_record_settings
from namod_ctl.app.build_twin import build_twin
from namod_ctl.app.build_twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.commands.instruct import write_instructions
from namod_ctl.app.config import InstrumentConfig
from namod_ctl.app.instruction_sheets import PDF_FILE
from namod_ctl.app.reconstruction_report import REPORT_FILE, report_text
from namod_ctl.core.clock import Clock
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings, Outside, View
from namod_ctl.cycle.correct import Corrector
from namod_ctl.cycle.correct_by_hand import ManualCorrector
from namod_ctl.cycle.correct_by_motor import MotorCorrector
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.record import Equipment
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.results import write_results
from namod_ctl.twin.operator import GONIOMETER_ERROR_RAD, TwinOperator
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin
from namod_ctl.twin.world import open_world

WORLD_FILE = "twin_world.jsonl"


@dataclass(frozen=True, slots=True)
class TwinCampaign:
    """A campaign, and the twin that it aligns."""

    campaign: Campaign
    twin: Twin


@contextmanager
def open_twin_campaign(
    store: CampaignStore,
    config: InstrumentConfig,
    settings: TwinSettings,
    seed: int,
    wishes: CampaignSettings,
    clock: Clock,
    switch: StopSwitch,
    view: View,
    mistakes: Mapping[int, str] | None = None,
) -> Iterator[TwinCampaign]:
    """The campaign in `store` on the twin of its config; by motors where the config has [actuators], else by people.

    The twin goes on where its world in the campaign's folder stands. Of `wishes.record` only `keep_frames` is used: the
    pace is chosen so that a cycle's records fill one pass of the telescope over its region, the rest is in the config.

    Parameters
    ----------
    mistakes
        That the twin's operator makes, see `twin.operator`.
    """
    with ExitStack() as stack:
        twin = build_twin(config, settings, seed, twin_wiring(config))
        stack.callback(open_world(store.path / WORLD_FILE, twin).close)
        record = replace(
            build_record_settings(config),
            pace_s=twin.telescope.pass_s / wishes.n_records,
            region_radius_rad=settings.telescope.radius_rad,
            keep_frames=wishes.record.keep_frames,
        )
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        outside = Outside(lambda: equipment, alignment_to_json, alignment_from_json, _write_cycle)
        corrector: Corrector
        if config.actuators is None:
            corrector = _by_people(store, twin, TwinOperator(twin, seed, mistakes=mistakes))
        else:
            corrector = _by_motors(stack, store, config, twin, switch)
        campaign = Campaign(
            store, twin.instrument, corrector, outside, replace(wishes, record=record), clock, switch, view
        )
        yield TwinCampaign(campaign, twin)


def _by_people(store: CampaignStore, twin: Twin, operator: TwinOperator) -> Corrector:
    def write_sheets(run: Path, alignment: Alignment) -> str:
        write_instructions(run, alignment, twin.instrument, None, f"{store.path.name}/{run.name}")
        return f"sheets for the ladder: {run / PDF_FILE}; then namod-ctl done {store.path} --facet ... or --all"

    return ManualCorrector(store, twin.instrument, write_sheets, GONIOMETER_ERROR_RAD, operator.turn)


def _by_motors(
    stack: ExitStack, store: CampaignStore, config: InstrumentConfig, twin: Twin, switch: StopSwitch
) -> Corrector:
    buses = stack.enter_context(build_twin_actuators(config, twin.drives))
    motion = build_motion_settings(config)
    drives = {leg: drive for bus in buses for leg, drive in bus.drives.items()}

    def show(heard: Mapping[Leg, DriveState | str]) -> None:
        with suppress(StoreError):  # the journal, which matters, meets the same trouble and says so
            store.show_legs(heard)

    mover = Mover(buses, twin.clock, motion, switch, show)
    return MotorCorrector(store, twin.instrument, mover, drives, motion, twin.clock)


def _write_cycle(run: Path, result: Reconstruction) -> None:
    write_results(run, {REPORT_FILE: report_text(result, {}).encode()} | alignment_files(result.alignment))
