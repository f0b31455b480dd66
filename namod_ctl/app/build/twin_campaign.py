"""A campaign on the digital twin: everything that works together, opened in order and closed in the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

from namod_ctl.app.build.bench_sky import twin_equipment
from namod_ctl.app.build.correctors import campaign_outside, correct_by_motors, correct_by_people
from namod_ctl.app.build.psf_camera import twin_psf_equipment
from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.twin import build_twin, instrument_on_twin
from namod_ctl.app.build.twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.clock import Clock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.twin.operator import TwinOperator
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
        instrument = instrument_on_twin(config)
        cameras = stack.enter_context(twin_equipment(config, twin))
        outside = campaign_outside(cameras, twin_psf_equipment(config, twin, seed))
        if config.actuators is None:
            operator = TwinOperator(twin, seed, mistakes=mistakes)
            corrector = correct_by_people(store, instrument, operator.turn)
        else:
            buses = stack.enter_context(build_twin_actuators(config, twin.drives))
            corrector = correct_by_motors(store, config, instrument, buses, twin.clock, switch)
        campaign = Campaign(store, instrument, corrector, outside, replace(wishes, record=record), clock, switch, view)
        yield TwinCampaign(campaign, twin)
