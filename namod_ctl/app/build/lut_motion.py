"""The drives that a look-up table moves, and the journal of what it moved, opened together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from namod_ctl.app.build.actuators import build_motion_settings, open_actuators
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.build.twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.build.twin_campaign import WORLD_FILE
from namod_ctl.app.build.twin_note import note_twin, noted_twin
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.clock import Clock, SystemMonotonicClock
from namod_ctl.core.drives import Drive, Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.cycle.control import ControlBox, RequestKind
from namod_ctl.cycle.correct import StopAsked
from namod_ctl.cycle.correct_by_motor import MotorCorrector
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.table_move import NOTE_JOURNAL
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin
from namod_ctl.twin.world import open_world


@dataclass(frozen=True, slots=True)
class TableRig:
    """What a table is applied with."""

    store: CampaignStore
    instrument: Instrument
    mover: Mover
    corrector: MotorCorrector
    drives: Mapping[Leg, Drive]
    settings: MotionSettings
    switch: StopSwitch
    control: ControlBox
    twin: Twin | None

    def poll(self) -> None:
        """Look whether somebody asks to stop from another terminal. Raises StopAsked."""
        for request in self.control.poll():
            is_stop = request.kind is RequestKind.STOP
            text = "all drives stop" if is_stop else f"not possible now: a look-up table is applied ({request.kind})"
            if is_stop:
                self.switch.throw("namod-ctl stop")
            self.control.answer(request, text, is_accepted=is_stop)
        if self.switch.is_thrown:
            raise StopAsked(self.switch.reason)


class _OwnNotes:
    """Notes of a journal under names of their own: it is no campaign of the twin, and none may be taken up from it."""

    def __init__(self, store: CampaignStore) -> None:
        self.path, self._store = store.path, store

    def note(self, key: str) -> str | None:
        return self._store.note(f"lut.{key}")

    def set_note(self, key: str, text: str) -> None:
        self._store.set_note(f"lut.{key}", text)


@contextmanager
def open_table_rig(
    journal: Path, config: InstrumentConfig, clock: Clock, twin: tuple[TwinSettings, int] | None, *, is_new: bool
) -> Iterator[TableRig]:
    """The journal at `journal`, made if it is not there, and the drives of the config, or of its twin.

    Parameters
    ----------
    twin
        Settings and seed of the twin; None for the telescope's own drives. A journal keeps its twin.
    is_new
        May a journal be made? Else it must be there.

    Raises
    ------
    ConfigError
        An instrument without actuators, a journal that is not there or not of these drives, a folder that is none.
    """
    what = "telescope" if twin is None else "twin"
    with ExitStack() as stack:
        store = None
        if is_campaign(journal):
            store = stack.enter_context(CampaignStore.open(journal, read_only=False, clock=clock))
            _refuse_other_journal(store, config, what)
        elif not is_new:
            raise ConfigError(
                f"{journal}: there is no journal yet, so nobody knows at which zenith distance the facets were "
                "aligned as they stand: say it once, --aligned-at-deg 30"
            )
        buses = stack.enter_context(open_actuators(config)) if twin is None else []
        if store is None:  # not before the drives' lines are open
            source = f"moves by look-up table, {'digital twin of ' if twin else ''}{config.telescope.name}"
            store = stack.enter_context(CampaignStore.create(journal, config.to_json(), source, clock))
            store.set_note(NOTE_JOURNAL, what)
        switch = StopSwitch()
        seconds: MonotonicClock
        its_twin = None
        if twin is None:
            seconds, instrument = SystemMonotonicClock(), build_instrument(config)
        else:
            notes = _OwnNotes(store)
            if noted_twin(notes) is None:
                note_twin(notes, *twin)
            used = noted_twin(notes)
            assert used is not None
            its_twin = build_twin(config, *used, twin_wiring(config))
            stack.callback(open_world(journal / WORLD_FILE, its_twin).close)
            seconds, instrument = its_twin.clock, its_twin.instrument
            buses = stack.enter_context(build_twin_actuators(config, its_twin.drives))
        settings = build_motion_settings(config)
        drives = {leg: drive for bus in buses for leg, drive in bus.drives.items()}
        mover = Mover(buses, seconds, settings, switch)
        corrector = MotorCorrector(store, instrument, mover, drives, settings, seconds)
        control = ControlBox(store.path)
        yield TableRig(store, instrument, mover, corrector, drives, settings, switch, control, its_twin)


def _refuse_other_journal(store: CampaignStore, config: InstrumentConfig, what: str) -> None:
    noted = store.note(NOTE_JOURNAL)
    if noted != what:
        of_what = "a campaign, no journal of a look-up table" if noted is None else f"the journal of a {noted}"
        raise ConfigError(f"{store.path}: is {of_what}; name another --journal")
    if InstrumentConfig.from_json(store.config_json, f"{store.path}: config").actuators != config.actuators:
        raise ConfigError(f"{store.path}: is of other drives than those of the config; name another --journal")
