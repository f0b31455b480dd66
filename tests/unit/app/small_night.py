"""Short nights on a small twin: eight of FACT's facets with bolts, cameras with fewer pixels, nothing that sags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.build.twin_campaign import open_twin_campaign
from namod_ctl.app.build.twin_note import note_twin
from namod_ctl.app.commands.reconstruct import reconstruct_run
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import ReflectorSettings, TelescopeSettings, TwinSettings
from namod_ctl.twin.twin import Twin

FACET_IDS = (3, 4, 5, 10, 19, 21, 22, 24)
SEED = 2
SETTINGS = TwinSettings(
    reflector=ReflectorSettings(
        misalignment_rad=arcmin_to_rad(2.5), sag_rad=0.0, drift_rad_per_kelvin=0.0
    ),  # so that the truth of a comparison is what the test does and nothing else
    telescope=TelescopeSettings(radius_rad=deg_to_rad(0.2)),
)


def small_config(**star_camera) -> InstrumentConfig:
    """FACT with eight facets and smaller pictures of the same fields."""
    config = load_config("fact")
    facets = tuple(facet for facet in config.facets if facet.id in FACET_IDS)
    star = {"columns": 640, "rows": 480, "axis_px": (320.0, 240.0)} | star_camera
    return config.model_copy(
        update={
            "reflector": config.reflector.model_copy(update={"facets": facets}),
            "reflector_map": None,
            "star_camera": config.star_camera.model_copy(update=star),
            "reflector_camera": config.reflector_camera.model_copy(update={"columns": 384, "rows": 288}),
        }
    )


def small_twin(config: InstrumentConfig) -> Twin:
    """The twin of that config, always the same telescope."""
    return build_twin(config, SETTINGS, SEED)


def record(path: Path, twin: Twin, config: InstrumentConfig, n_records: int) -> Path:
    """A run of that twin as it stands, reconstructed."""
    settings = replace(build_record_settings(config), pace_s=twin.telescope.pass_s / n_records)
    source = f"digital twin of FACT, seed {SEED}"
    with RunStore.create(path, FACET_IDS, config.to_json(), source, twin.wall_clock) as run:
        note_twin(run, SETTINGS, SEED)
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        Recorder(equipment, twin.instrument, run, settings).record(StopRule(n_records=n_records))
    reconstruct_run([path])
    return path


def manual_campaign(path: Path, n_records: int = 100) -> Path:
    """A campaign that ended: recorded, turned by people, recorded again."""
    config = small_config()
    source = f"digital twin of FACT, seed {SEED}"
    with CampaignStore.create(path, config.to_json(), source, SystemClock()) as store:
        note_twin(store, SETTINGS, SEED)
        wishes = CampaignSettings(RecordSettings(), n_records, 1)
        with open_twin_campaign(
            store, config, SETTINGS, SEED, wishes, SystemClock(), StopSwitch(), _MarksAllDone()
        ) as opened:
            opened.campaign.run()
    return path


class _MarksAllDone(View):
    """Somebody who says that all bolts are turned whenever the campaign asks."""

    def turned(self):
        return "all"
