"""Who turns the facets of a campaign: motors or people; the same on the sky as on the twin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from namod_ctl.app.alignment_files import alignment_files, alignment_from_json, alignment_to_json
from namod_ctl.app.build.actuators import build_motion_settings
from namod_ctl.app.commands.instruct import write_instructions
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.reconstruction_report import REPORT_FILE, report_text
from namod_ctl.app.sheets.ladder_sheets import PDF_FILE
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.units import deg_to_rad
from namod_ctl.cycle.campaign_parts import Outside
from namod_ctl.cycle.correct import Corrector
from namod_ctl.cycle.correct_by_hand import ManualCorrector
from namod_ctl.cycle.correct_by_motor import MotorCorrector
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.psf_check import OpenPsfEquipment
from namod_ctl.cycle.record import Equipment
from namod_ctl.devices.buses import DriveBus
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.results import write_results

GONIOMETER_SIGMA_RAD = deg_to_rad(3.0)
"""How well a careful person sets a turn with a goniometer, one standard deviation."""


def correct_by_people(
    store: CampaignStore,
    instrument: Instrument,
    on_done: Callable[[int, Sequence[float]], None] = lambda facet_id, turns_deg: None,
) -> Corrector:
    """Sheets for people; `on_done` as in `ManualCorrector`."""

    def write_sheets(run: Path, alignment: Alignment) -> str:
        write_instructions(run, alignment, instrument, None, f"{store.path.name}/{run.name}")
        return f"sheets for the ladder: {run / PDF_FILE}; then namod-ctl done {store.path} --facet ... or --all"

    return ManualCorrector(store, instrument, write_sheets, GONIOMETER_SIGMA_RAD, on_done)


def correct_by_motors(
    store: CampaignStore,
    config: InstrumentConfig,
    instrument: Instrument,
    buses: Sequence[DriveBus],
    clock: MonotonicClock,
    switch: StopSwitch,
) -> Corrector:
    """Moves the legs with the drives of these buses, which are open."""
    motion = build_motion_settings(config)
    drives = {leg: drive for bus in buses for leg, drive in bus.drives.items()}

    def show(heard: Mapping[Leg, DriveState | str]) -> None:
        with suppress(StoreError):  # the journal, which matters, meets the same trouble and says so
            store.show_legs(heard)

    mover = Mover(buses, clock, motion, switch, show)
    return MotorCorrector(store, instrument, mover, drives, motion, clock)


def campaign_outside(open_equipment: Callable[[], Equipment], open_psf: OpenPsfEquipment | None) -> Outside:
    """What a campaign needs from above: its cameras, opened anew for each recording, and the files of its results."""
    return Outside(open_equipment, alignment_to_json, alignment_from_json, _write_cycle, open_psf)


def _write_cycle(run: Path, result: Reconstruction) -> None:
    write_results(run, {REPORT_FILE: report_text(result, {}).encode()} | alignment_files(result.alignment))
