"""A recording with the telescope's own cameras: a run to record into, and the cameras, opened in order."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from namod_ctl.app.build.cameras import has_cameras, open_cameras
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin_note import noted_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock, SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.exposure_check import refuse_disobedient
from namod_ctl.cycle.record import Equipment
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.folders import check_output
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_lock import recording_lock

DEFAULT_CONFIG = "fact"

Tell = Callable[[str], None]
"""Says something to whoever waits."""


@dataclass(frozen=True, slots=True)
class SkySession:
    """What is recorded with, and into what; all of it is closed by the stack that it was opened on."""

    equipment: Equipment
    instrument: Instrument
    config: InstrumentConfig
    store: RunStore


def open_sky_session(
    stack: ExitStack,
    out: Path | None,
    append: Path | None,
    config_name: str | None,
    *,
    force: bool,
    tell: Tell = lambda text: None,
) -> SkySession | None:
    """A new run at `out`, or the run `append`, and the cameras of its config; None when that names no cameras.

    The cameras are opened before a run is begun or replaced. `tell` is told how they obey, see `try_exposures`.

    Raises
    ------
    ConfigError
        A camera refuses a setting or ignores its exposure, the config has no outlines of the facets, something is at
        `out`, or `append` is of another config.
    DeviceFaultError
        There is no such camera.
    """
    if append is not None:
        return _resumed(stack, append, config_name, tell)
    config = load_config(config_name or DEFAULT_CONFIG)
    if out is None or not has_cameras(config):
        return None
    instrument = mapped_instrument(config)
    check_output(out, force=force)
    equipment = _open_equipment(stack, config)
    try_exposures(config, equipment, instrument, tell)
    source = f"{equipment.star_camera.name}; {equipment.reflector_camera.name}"
    facet_ids = [facet.id for facet in config.facets]
    store = RunStore.create(out, facet_ids, config.to_json(), source, equipment.wall_clock, force)
    stack.enter_context(store)
    stack.enter_context(recording_lock(store.path))
    return SkySession(equipment, instrument, config, store)


def _resumed(stack: ExitStack, run: Path, config_name: str | None, tell: Tell) -> SkySession | None:
    with RunStore.open(run) as store:
        config = InstrumentConfig.from_json(store.config_json, f"{run}: config")
        if noted_twin(store) is not None or not has_cameras(config):
            return None
    if config_name is not None and load_config(config_name) != config:
        raise ConfigError(f"{run}: was recorded with another config; leave --config out to go on with its own")
    instrument = mapped_instrument(config)
    equipment = _open_equipment(stack, config)
    try_exposures(config, equipment, instrument, tell)
    store = stack.enter_context(RunStore.open(run, read_only=False))
    stack.enter_context(recording_lock(store.path))
    return SkySession(equipment, instrument, config, store)


def try_exposures(config: InstrumentConfig, equipment: Equipment, instrument: Instrument, tell: Tell) -> None:
    """Try whether the cameras make the exposures that they are asked for; not asked of folders of frames.

    `tell` is told that it begins, as it takes a while in the dark, and what was found.

    Raises
    ------
    ConfigError
        One does not.
    DeviceFaultError
        One is lost.
    """
    cameras = (
        (config.star_camera, equipment.star_camera, instrument.star_camera),
        (config.reflector_camera, equipment.reflector_camera, instrument.reflector_camera),
    )
    asked = [
        (camera, model, None)
        for section, camera, model in cameras
        if section.device is not None and section.device.driver != "folder"  # whoever fills it exposes as he likes
    ]
    if not asked:
        return
    tell("Trying whether the cameras make the exposures that they are asked for; in the dark this takes half a minute.")
    for remark in refuse_disobedient(asked, equipment.clock):
        tell(remark)


def mapped_instrument(config: InstrumentConfig) -> Instrument:
    """The telescope of a config. Raises ConfigError when it does not say where the facets are in the image."""
    instrument = build_instrument(config)
    if not instrument.facet_polygons_px:
        raise ConfigError(
            "the config has no [reflector_map]: without the facets' outlines in the reflector camera's image nothing "
            "can be measured; mark them with namod-ctl facets edit"
        )
    return instrument


def _open_equipment(stack: ExitStack, config: InstrumentConfig) -> Equipment:
    clock = SystemMonotonicClock()
    star_camera, reflector_camera = open_cameras(config, clock)
    stack.callback(star_camera.close)
    stack.callback(reflector_camera.close)
    return Equipment(star_camera, reflector_camera, clock, SystemClock())
