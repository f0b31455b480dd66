"""What the PSF camera says of the reflector, as a check of what the records say: frames, measurement, comparison.

The two methods share nothing but the star: a campaign's estimate adds up facets as the reflector camera saw them light
up one after the other, the PSF camera sees the light of all of them at once. The check never stops a campaign: where
it cannot measure, it says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from namod_ctl.core.errors import CommunicationError, DataQualityError, NamodError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_deg, s_to_ms
from namod_ctl.cycle.frame_integrity import FrameGuard
from namod_ctl.cycle.psf_off_axis import OnAxis, on_axis
from namod_ctl.imaging.exposure import exposure_rule, frame_statistics, next_exposure_s
from namod_ctl.imaging.psf_combine import Exposed, Psf, combine_images
from namod_ctl.imaging.psf_image import measure_psf
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.reflector import Reflector
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle

EVENT = "psf_check"
AT_FIRST = "before the first correction"
"""`when` of the check that a campaign begins with."""
LONGEST_S = 5.0
"""No frame is exposed longer: the check is to be over within a minute."""
TARGET_SHARE, LEAST_SHARE = 0.7, 0.35
"""Brightest pixel, of full scale: aimed at, and so dark that the next exposure is made longer."""
MORE_ATTEMPTS = 12
"""Than frames are wanted: to find the exposure, and for frames without a usable spot."""
AGREE_SIGMAS = 2.5
MOST_DIGITS = 4
METHODS_SHARE = 0.04
"""Of the area: what two methods differ by that look at other moments and through another opening; on the twin up to
5 %, where both are known to be right to a few per cent."""

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PsfEquipment:
    """The PSF camera, open, and how it is used.

    Attributes
    ----------
    exposure_s
        To begin with.
    n_frames
        That are wanted.
    reflector
        As it should be: tells what the star's distance from the axis adds to its image.
    """

    camera: Camera
    model: CameraModel
    clock: MonotonicClock
    exposure_s: float
    n_frames: int
    reflector: Reflector
    fetch_timeout_s: float = 2.0


OpenPsfEquipment = Callable[[], PsfEquipment]


def expose_psf(equipment: PsfEquipment, tell: Tell = lambda text: None) -> list[Exposed]:
    """Images of the star's spot, as many as are wanted where that is possible.

    Frames that are saturated, too dark or without a usable spot are retaken, a bounded number of times.

    Raises
    ------
    DataQualityError
        There is none: what was wrong with the last frame.
    ConfigError, DeviceFaultError, LimitError
        The camera does not suit its config, or is lost.
    """
    camera, model = equipment.camera, equipment.model
    shortest_s, longest_s = camera.exposure_range_s
    longest_s = max(min(longest_s, LONGEST_S), shortest_s)
    rule = exposure_rule(model, shortest_s, longest_s, TARGET_SHARE, LEAST_SHARE)
    exposure_s = rule.clipped(equipment.exposure_s)
    guard = FrameGuard()
    good: list[Exposed] = []
    why = ""
    for _ in range(equipment.n_frames + MORE_ATTEMPTS):
        if len(good) == equipment.n_frames:
            break
        try:
            started_s = equipment.clock.monotonic_s()
            camera.start(exposure_s)
            frame = camera.fetch(equipment.fetch_timeout_s)
            if fault := guard.fault(frame, started_s):
                raise CommunicationError(fault[1])
            statistics = frame_statistics(frame.image, model)
            wanted_s = next_exposure_s(statistics, frame.exposure_s, rule)
            is_dark = statistics.brightest_adu < LEAST_SHARE * model.full_scale_adu
            if statistics.brightest_adu >= rule.saturation_adu or (is_dark and wanted_s > 1.1 * frame.exposure_s):
                why = f"saturated or dark at {s_to_ms(frame.exposure_s):.3g} ms"
                exposure_s = wanted_s
                continue
            image = measure_psf(frame.image, model, frame.exposure_s)
        except (CommunicationError, DataQualityError) as error:
            why = str(error)
            tell(f"a frame of the PSF camera is taken again: {why}")
            continue
        good.append(Exposed(image, frame.exposure_s, frame.mid_exposure_s))
    if not good:
        raise DataQualityError(why or "no frame came")
    return good


def _measured(open_equipment: OpenPsfEquipment, tell: Tell) -> tuple[Psf, OnAxis]:
    """What the PSF camera sees now. Raises what `expose_psf` raises, and what opening the camera does."""
    equipment = open_equipment()
    try:
        psf = combine_images(expose_psf(equipment, tell), equipment.model.plate_scale_rad)
    finally:
        equipment.camera.close()
    return psf, on_axis(psf, equipment.model, equipment.reflector)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A_sigma by the PSF camera beside that of a cycle's estimate."""

    cycle: int
    a_sigma_rad2: float
    uncertainty_rad2: float
    estimate_rad2: float
    estimate_uncertainty_rad2: float

    @property
    def sigmas(self) -> float:
        """Difference in units of its uncertainty, positive where the camera sees the larger area.

        Estimators of other programs state no uncertainty (NaN): then that of the methods stands for it.
        """
        methods_rad2 = METHODS_SHARE * self.estimate_rad2
        stated = [u for u in (self.uncertainty_rad2, self.estimate_uncertainty_rad2) if math.isfinite(u)]
        doubt = math.hypot(*stated, methods_rad2)
        return (self.a_sigma_rad2 - self.estimate_rad2) / doubt

    @property
    def text(self) -> str:
        """For people."""
        estimate = _area_text(self.estimate_rad2, self.estimate_uncertainty_rad2)
        share = self.a_sigma_rad2 / self.estimate_rad2 - 1.0
        apart = (
            f"{share:+.1%}, {abs(self.sigmas):.1f} sigma with the {METHODS_SHARE:.0%} that the methods may differ by"
        )
        if abs(self.sigmas) <= AGREE_SIGMAS:
            return f"the estimate of cycle {self.cycle} is {estimate}: they agree ({apart})"
        return (
            f"the estimate of cycle {self.cycle} is {estimate}: they do NOT agree ({apart}); check the PSF camera's "
            "plate scale and focus, and that the screen stands in the focal plane"
        )


def check_psf(store: CampaignStore, open_equipment: OpenPsfEquipment | None, when: str, tell: Tell) -> None:
    """Look through the PSF camera, compare with the last estimate, and keep both in the campaign's journal.

    Nothing where the campaign has no such camera. `when` names the moment for people; the first check of a campaign is
    not repeated after a restart.
    """
    if open_equipment is None:
        return
    try:
        psf, centred = _measured(open_equipment, tell)
    except (NamodError, OSError) as error:
        text = f"PSF camera, {when}: not measured: {error}"
        store.add_event(EVENT, text, {"when": when, "is_measured": False})
        tell(text)
        return
    seen = _area_text(centred.a_sigma_rad2, centred.uncertainty_rad2)
    there = _area_text(psf.a_sigma_rad2, psf.a_sigma_uncertainty_rad2)
    text = (
        f"PSF camera, {when}: A_sigma is {seen} on the axis, from {psf.n_images} images of a star "
        f"{rad_to_deg(centred.off_axis_rad):.2f} deg off it, where it is {there}"
    )
    data: dict[str, bool | int | float | str | None] = {
        "when": when,
        "is_measured": True,
        "n_images": psf.n_images,
        "a_sigma_rad2": centred.a_sigma_rad2,
        "uncertainty_rad2": centred.uncertainty_rad2,
        "off_axis_rad": centred.off_axis_rad,
        "a_sigma_off_axis_rad2": psf.a_sigma_rad2,
    }
    cycle = _comparable_cycle(store)
    if cycle is None:
        text += "; there is no estimate of this state of the mirror to compare it with"
    else:
        compared = Comparison(
            cycle.number,
            centred.a_sigma_rad2,
            centred.uncertainty_rad2,
            cycle.a_sigma_now_rad2,
            cycle.a_sigma_uncertainty_rad2,
        )
        text += f"; {compared.text}"
        data |= {
            "cycle": cycle.number,
            "estimate_rad2": cycle.a_sigma_now_rad2,
            "estimate_uncertainty_rad2": (
                cycle.a_sigma_uncertainty_rad2 if math.isfinite(cycle.a_sigma_uncertainty_rad2) else None
            ),
            "difference_sigmas": compared.sigmas,
        }
    for remark in psf.remarks:
        text += f". {remark[0].upper()}{remark[1:]}"
    store.add_event(EVENT, text, data)
    tell(text)


def was_checked(store: CampaignStore, when: str) -> bool:
    """Whether that check has been made in this campaign."""
    return any(event.kind == EVENT and event.data.get("when") == when for event in store.events())


def _comparable_cycle(store: CampaignStore) -> Cycle | None:
    """The last cycle, if its estimate is of the mirror as it stands: nothing was ordered or turned since."""
    cycles = store.cycles()
    if not cycles or cycles[-1].alignment_json is None or not math.isfinite(cycles[-1].a_sigma_now_rad2):
        return None
    last = cycles[-1]
    if store.orders(last.number) or any(turns.is_done for turns in store.turns(last.number)):
        return None
    return last


def _area_text(area_rad2: float, uncertainty_rad2: float) -> str:
    area, uncertainty = rad2_to_arcmin2(area_rad2), rad2_to_arcmin2(uncertainty_rad2)
    if not math.isfinite(uncertainty):
        return f"{area:.2f} arcmin2 (uncertainty not stated)"
    if not uncertainty > 0.0:
        return f"{area:.2f} arcmin2"
    digits = min(max(2, -math.floor(math.log10(uncertainty))), MOST_DIGITS)
    return f"{area:.{digits}f} +- {uncertainty:.{digits}f} arcmin2"
