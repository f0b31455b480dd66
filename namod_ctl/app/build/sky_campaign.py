"""A campaign on the telescope itself: its cameras, and its drives or its crew."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from namod_ctl.app.build.actuators import check_ports, open_actuators
from namod_ctl.app.build.cameras import open_cameras
from namod_ctl.app.build.correctors import campaign_outside, correct_by_motors, correct_by_people
from namod_ctl.app.build.psf_camera import sky_psf_equipment
from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.sky_session import Tell, mapped_instrument, try_exposures
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.clock import Clock, SystemClock, SystemMonotonicClock
from namod_ctl.core.errors import NamodError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings, View
from namod_ctl.cycle.record import Equipment
from namod_ctl.store.campaign import CampaignStore


def check_hardware(config: InstrumentConfig, tell: Tell) -> list[str]:
    """Open the cameras and the drives' lines for a moment, and try the cameras' exposures; the cameras' names.

    `tell` as in `try_exposures`.

    Raises
    ------
    ConfigError, DeviceFaultError
        What can not be opened, or does not make its exposures; nothing has moved.
    """
    instrument = mapped_instrument(config)
    seconds = SystemMonotonicClock()
    cameras = open_cameras(config, seconds)
    try:
        names = [camera.name for camera in cameras]
        try_exposures(config, Equipment(*cameras, seconds, SystemClock()), instrument, tell)
    finally:
        for camera in cameras:
            camera.close()
    names += psf_camera_name(config, tell)
    if config.actuators is not None:
        check_ports(config)
    return names


def psf_camera_name(config: InstrumentConfig, tell: Tell) -> list[str]:
    """Name of the PSF camera, if there is one; it only verifies, so that nothing stops without it."""
    open_equipment = sky_psf_equipment(config)
    if open_equipment is None:
        return []
    try:
        camera = open_equipment().camera
    except NamodError as error:
        tell(f"The PSF camera cannot be used now; the campaign goes on without it: {error}")
        return []
    camera.close()
    return [camera.name]


@contextmanager
def open_sky_campaign(
    store: CampaignStore,
    config: InstrumentConfig,
    wishes: CampaignSettings,
    clock: Clock,
    switch: StopSwitch,
    view: View,
) -> Iterator[Campaign]:
    """The campaign in `store` with the config's cameras; by motors where it has [actuators], else by people.

    Cameras are opened anew for every recording. Of `wishes.record` only `keep_frames` is used, the rest is in the
    config.

    Raises
    ------
    ConfigError, CommunicationError
        A line of the drives cannot be opened; nothing has moved.
    """
    seconds = SystemMonotonicClock()
    instrument = mapped_instrument(config)
    with ExitStack() as stack:
        if config.actuators is None:
            corrector = correct_by_people(store, instrument)
        else:
            buses = stack.enter_context(open_actuators(config))
            corrector = correct_by_motors(store, config, instrument, buses, seconds, switch)
        outside = campaign_outside(
            lambda: Equipment(*open_cameras(config, seconds), seconds, SystemClock()), sky_psf_equipment(config)
        )
        record = replace(build_record_settings(config), keep_frames=wishes.record.keep_frames)
        yield Campaign(store, instrument, corrector, outside, replace(wishes, record=record), clock, switch, view)
