"""Cameras that follow their exposure setting, and such that do not, under steady and unsteady light.

The light of the fake night follows the published radiometric laws, solved there for the response.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fake_night import REFLECTOR, STAR, FakeCamera, Night

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle import exposure_check
from namod_ctl.cycle.exposure_check import refuse_disobedient
from namod_ctl.cycle.exposure_growth import LEVEL_RATIO, ExposureCheck, ExposureFinding, ExposureFrames, judged
from namod_ctl.imaging.exposure import exposure_rule
from namod_ctl.optics.camera_model import CameraModel


def check_exposure(camera: FakeCamera | DisobedientCamera, model: CameraModel) -> ExposureCheck:
    return exposure_check.check_exposure(camera, model, camera.clock)


class DisobedientCamera:
    """Reports the exposure it is asked for, and makes the one that `really` says."""

    def __init__(self, camera: FakeCamera, really: Callable[[float], float], *, is_honest: bool = False) -> None:
        self._camera, self._really, self._is_honest = camera, really, is_honest
        self.name, self.exposure_range_s, self.clock = camera.name, camera.exposure_range_s, camera.clock

    def start(self, exposure_s: float) -> None:
        self._asked_s = exposure_s
        self._camera.start(self._really(exposure_s))

    def fetch(self, timeout_s: float) -> Exposure:
        exposure = self._camera.fetch(timeout_s)
        return exposure if self._is_honest else replace(exposure, exposure_s=self._asked_s)

    def close(self) -> None:
        self._camera.close()


CAMERAS = [("star", STAR), ("reflector", REFLECTOR)]


@pytest.mark.parametrize(("role", "model"), CAMERAS)
def test_a_camera_that_obeys_passes(role: str, model: CameraModel) -> None:
    check = check_exposure(getattr(Night(), role), model)
    assert check.verdict is ExposureFinding.FOLLOWS, check.text
    assert check.growth == pytest.approx(1.0, abs=0.1)  # both laws are the published ones; 3 adu of offset


@pytest.mark.parametrize(("role", "model"), CAMERAS)
def test_a_camera_that_ignores_its_setting_is_refused_with_the_numbers(role: str, model: CameraModel) -> None:
    needs_s = 0.04 if role == "star" else 0.2
    camera = DisobedientCamera(getattr(Night(), role), lambda asked_s: 0.7 * needs_s)
    check = check_exposure(camera, model)
    assert check.verdict is ExposureFinding.REFUSED, check.text
    assert abs(check.growth) < 0.1
    assert (
        f"its light grew {math.exp(check.growth * math.log(2.0) * -model.law.r_expo / model.law.r_resp):.2f} times"
        in (check.text)
    )
    expected = LEVEL_RATIO ** (-model.law.r_expo / model.law.r_resp)
    assert f"grew {expected**check.growth:.2f} times" in check.text
    assert f"expected were {expected:.2f} times" in check.text
    assert len(check.levels) == 3
    assert all(f"{level.light_share:.1%}" in check.text for level in check.levels)


def test_a_webcam_that_keeps_its_frame_rate_is_refused_where_it_begins_to() -> None:
    """Obeys up to 1/30 s, and makes 1/30 s beyond: the star is found at longer ones only."""
    night = Night(star_of=lambda time_s: 0.35)
    camera = DisobedientCamera(night.star, lambda asked_s: min(asked_s, 1.0 / 30.0))
    check = check_exposure(camera, STAR)
    assert check.verdict is ExposureFinding.REFUSED, check.text


def test_automatic_exposure_is_refused() -> None:
    """Whatever it is asked for, the star is at half of full scale."""
    night = Night(star_of=lambda time_s: 0.3 + 0.2 * math.sin(time_s))

    def automatic(asked_s: float) -> float:
        law = STAR.law
        wanted = 10.0 ** (math.log10(0.5 / 0.8) * law.r_resp / -law.r_expo)
        return float(0.04 * wanted * night.star_of(night.clock.now_s) ** (1.0 / law.r_expo))

    check = check_exposure(DisobedientCamera(night.star, automatic), STAR)
    assert check.verdict is ExposureFinding.REFUSED, check.text


def test_a_camera_that_admits_it_is_refused_by_what_it_says() -> None:
    check = check_exposure(DisobedientCamera(Night().star, lambda asked_s: 0.03, is_honest=True), STAR)
    assert check.verdict is ExposureFinding.REFUSED
    assert "it says 0.03 s" in check.text


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.49])
def test_coarse_steps_that_are_reported_are_no_reason_to_refuse(offset: float) -> None:
    """A webcam with exposures of 2**n s."""
    camera = DisobedientCamera(Night().star, lambda asked_s: 2.0 ** round(math.log2(asked_s) + offset), is_honest=True)
    check = check_exposure(camera, STAR)
    assert check.verdict is ExposureFinding.FOLLOWS, check.text


def cloud_comes(time_s: float) -> float:
    return math.exp(-0.3 * time_s)


def cloud_goes(time_s: float) -> float:
    return 0.2 + 0.8 * min(time_s / 4.0, 1.0)


def scintillation(time_s: float) -> float:
    return float(np.exp(0.12 * np.random.default_rng(int(time_s * 1e4)).normal()))


UNSTEADY = [cloud_comes, cloud_goes, scintillation]


@pytest.mark.parametrize("star_of", UNSTEADY)
def test_unsteady_light_does_not_make_a_good_camera_bad(star_of: Callable[[float], float]) -> None:
    check = check_exposure(Night(star_of=star_of).star, STAR)
    assert check.verdict is ExposureFinding.FOLLOWS, check.text


@pytest.mark.parametrize("star_of", UNSTEADY)
def test_unsteady_light_does_not_make_a_bad_camera_good(star_of: Callable[[float], float]) -> None:
    check = check_exposure(DisobedientCamera(Night(star_of=star_of).star, lambda asked_s: 0.03), STAR)
    assert check.verdict is ExposureFinding.REFUSED, check.text


def unknown(check: ExposureCheck, what: str) -> None:
    assert check.verdict is ExposureFinding.UNKNOWN, check.text
    assert "cannot be told" in check.text
    assert what in check.text


def test_what_cannot_be_told() -> None:
    unknown(check_exposure(Night(star_of=lambda time_s: 1e-6).star, STAR), "too dark")
    unknown(check_exposure(Night(star_of=lambda time_s: 1e5).star, STAR), "fainter")
    unknown(check_exposure(Night(star_of=lambda time_s: 1.0 if time_s < 0.12 else 1e-6).star, STAR), "too dark")
    wild = np.random.default_rng(3)
    unknown(check_exposure(Night(star_of=lambda time_s: float(np.exp(1.5 * wild.normal()))).star, STAR), "")


def test_lost_frames_and_cameras() -> None:
    night = Night()
    night.star.fault = lambda time_s: CommunicationError("late") if int(time_s * 1e3) % 5 == 0 else None
    assert check_exposure(night.star, STAR).verdict in (ExposureFinding.FOLLOWS, ExposureFinding.UNKNOWN)
    night.star.fault = lambda time_s: CommunicationError("late") if time_s > 0.0 else None
    unknown(check_exposure(night.star, STAR), "came")
    night.star.fault = lambda time_s: DeviceFaultError("gone")
    with pytest.raises(DeviceFaultError):
        check_exposure(night.star, STAR)


def test_an_evenly_lit_frame_is_light_too() -> None:
    """A lamp before the camera: background and brightest pixel are the same."""
    night = Night()

    def lamp(time_s: float, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
        return np.clip(rng.normal(3.0 + 800.0 * exposure_s, 1.0, (240, 320)), 0, 255).astype(np.uint8)

    night.star.render = lamp
    check = check_exposure(night.star, STAR)
    assert check.verdict is ExposureFinding.FOLLOWS, check.text
    fixed = DisobedientCamera(night.star, lambda asked_s: 0.15)
    assert check_exposure(fixed, STAR).verdict is ExposureFinding.REFUSED


def test_the_rest_of_a_frame_serves_where_something_in_it_is_always_saturated() -> None:
    night = Night()

    def lamp_with_glare(time_s: float, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
        frame = np.clip(rng.normal(3.0 + 2000.0 * exposure_s, 1.0, (240, 320)), 0, 255).astype(np.uint8)
        frame[100:120, 100:120] = 255
        return frame

    night.star.render = lamp_with_glare
    check = check_exposure(night.star, STAR)
    assert check.verdict is ExposureFinding.FOLLOWS, check.text
    assert check_exposure(DisobedientCamera(night.star, lambda s: 0.05), STAR).verdict is ExposureFinding.REFUSED


def test_a_camera_of_one_exposure_cannot_be_checked() -> None:
    night = Night()
    night.star.exposure_range_s = (0.04, 0.05)
    unknown(check_exposure(night.star, STAR), "no room")


def test_before_a_recording_both_are_checked_and_the_bad_one_is_refused() -> None:
    night = Night(star_of=lambda time_s: 1.0)
    good = [(night.star, STAR, None), (night.reflector, REFLECTOR, None)]
    assert ["follows" in text for text in refuse_disobedient(good, night.clock)] == [True, True]
    bad = (DisobedientCamera(night.star, lambda asked_s: 0.03), STAR, None)
    with pytest.raises(ConfigError, match="fake star camera: does not follow"):
        refuse_disobedient([bad, good[1]], night.clock)
    dark = Night(star_of=lambda time_s: 1e-9)
    told = refuse_disobedient([(dark.star, STAR, None)], dark.clock)
    assert "cannot be told" in told[0]
    assert len(dark.star.started) <= 8


@pytest.mark.parametrize("obeys", [True, False])
@pytest.mark.parametrize("jumps", [0.05, 0.2, 0.5])
def test_however_the_light_jumps_nobody_is_judged_wrongly(obeys: bool, jumps: float) -> None:
    """Frames of 60 checks each, made here: light that jumps by that share (rms of its logarithm) between frames."""
    wrong = ExposureFinding.REFUSED if obeys else ExposureFinding.FOLLOWS
    rule = exposure_rule(STAR, 1e-3, 3.0)
    rng = np.random.default_rng(7)
    levels_s = [0.01, 0.02, 0.04]
    found = []
    for _ in range(60):
        frames = ExposureFrames()
        for asked_s in (levels_s + levels_s[-2:0:-1]) * 12 + levels_s[:1]:
            grown = asked_s / 0.04 if obeys else 1.0
            light = 0.5 * grown**rule.response_per_exposure * math.exp(jumps * rng.normal())
            frames.asked_s.append(asked_s)
            frames.reported_s.append(asked_s)
            frames.light.append(light if light < 0.98 else math.nan)
        found.append(judged("camera", frames, levels_s, rule).verdict)
    assert wrong not in found
    decided = sum(finding is not ExposureFinding.UNKNOWN for finding in found)
    assert decided == 60 if jumps == 0.05 else jumps > 0.2 or decided > 40
