"""The look through the PSF camera: frames are retaken, exposures found, results compared; nothing stops a campaign."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "imaging"))

from frames import gaussian_light
from spot_frames import SHAPE, frame_of, psf_camera

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import CommunicationError, DataQualityError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.units import arcmin2_to_rad2, deg_to_rad, rad_to_deg
from namod_ctl.cycle.psf_check import AT_FIRST, EVENT, Comparison, PsfEquipment, check_psf, expose_psf, was_checked
from namod_ctl.cycle.psf_off_axis import on_axis
from namod_ctl.imaging.psf_combine import Psf
from namod_ctl.optics.raytrace import combine_moments, facet_moments, trace
from namod_ctl.store.campaign import CampaignStore

MODEL = psf_camera()
REFLECTOR = build_instrument(load_config("fact")).reflector
LIGHT = gaussian_light(SHAPE, 150.0, 120.0, 8.0)
AREA_RAD2 = math.pi * 64.0 * MODEL.plate_scale_rad**2


class Clock:
    """Seconds that pass with exposures."""

    def __init__(self):
        self.now_s = 0.0

    def monotonic_s(self):
        return self.now_s

    def wait_s(self, duration_s):
        self.now_s += duration_s


class ScreenCamera:
    """A camera whose frames are as bright as they are long; `troubles` befall its first fetches."""

    name = "psf camera (a test's)"
    exposure_range_s = (0.001, 3.0)

    def __init__(self, adu_per_s=1000.0, troubles=()):
        self.clock = Clock()
        self.adu_per_s, self.troubles = adu_per_s, list(troubles)
        self.exposures_s, self.n_closed = [], 0

    def start(self, exposure_s):
        self.exposures_s.append(exposure_s)

    def fetch(self, timeout_s):
        exposure_s, number = self.exposures_s[-1], len(self.exposures_s)
        self.clock.wait_s(exposure_s)
        trouble = self.troubles.pop(0) if self.troubles else None
        if isinstance(trouble, Exception):
            raise trouble
        light = np.zeros(SHAPE) if trouble == "dark" else self.adu_per_s * exposure_s * LIGHT
        frame = frame_of(light, np.random.default_rng(number))
        return Exposure(frame, exposure_s, self.clock.now_s - exposure_s / 2.0, number)

    def close(self):
        self.n_closed += 1


def equipment(camera, n_frames=3):
    return PsfEquipment(camera, MODEL, camera.clock, 0.1, n_frames, REFLECTOR)


@pytest.mark.parametrize("adu_per_s", [20.0, 1000.0, 60_000.0])
def test_exposure_is_found(adu_per_s):
    camera = ScreenCamera(adu_per_s)
    images = expose_psf(equipment(camera))
    assert len(images) == 3
    for one in images:
        assert one.image.a_sigma_px2 == pytest.approx(math.pi * 64.0, rel=0.12)
        assert one.image.peak_share < 0.98
    assert len(camera.exposures_s) <= 8


def test_frames_without_a_spot_are_retaken():
    camera = ScreenCamera(troubles=[CommunicationError("no frame"), None, "dark", None])
    told = []
    assert len(expose_psf(equipment(camera), told.append)) == 3
    assert any("no frame" in text for text in told)


def test_it_gives_up():
    camera = ScreenCamera(troubles=["dark"] * 100)
    with pytest.raises(DataQualityError):
        expose_psf(equipment(camera))
    assert len(camera.exposures_s) <= 3 + 12


@pytest.fixture
def store(tmp_path):
    with CampaignStore.create(tmp_path / "CAMPAIGN", "{}", "a test", SystemClock()) as opened:
        yield opened


@pytest.mark.parametrize(
    "trouble", [DeviceFaultError("unplugged"), "dark", OSError(5, "unplugged")], ids=["lost", "no star", "broken"]
)
def test_what_fails_is_journaled_and_stops_nothing(store, trouble):
    camera, told = ScreenCamera(troubles=[trouble] * 100), []
    check_psf(store, lambda: equipment(camera), AT_FIRST, told.append)
    (event,) = [event for event in store.events() if event.kind == EVENT]
    assert "not measured" in event.text
    assert event.data == {"when": AT_FIRST, "is_measured": False}
    assert told[-1] == event.text
    assert camera.n_closed == 1
    assert was_checked(store, AT_FIRST)
    assert not was_checked(store, "in the end (converged)")


def test_camera_that_cannot_be_opened_stops_nothing(store):
    def open_equipment():
        raise DeviceFaultError("there is no such camera")

    check_psf(store, open_equipment, AT_FIRST, lambda text: None)
    assert "no such camera" in store.events()[-1].text


def test_nothing_without_a_camera(store):
    check_psf(store, None, AT_FIRST, lambda text: None)
    assert not store.events()


def test_measured_without_an_estimate(store):
    check_psf(store, lambda: equipment(ScreenCamera()), AT_FIRST, lambda text: None)
    (event,) = store.events()
    assert "no estimate of this state" in event.text
    assert event.data["a_sigma_rad2"] == pytest.approx(AREA_RAD2, rel=0.03)
    assert "cycle" not in event.data


@pytest.mark.parametrize(
    ("seen", "estimate", "words"),
    [
        ((6.1, 0.05), (6.3, 0.1), "they agree"),
        ((6.1, 0.05), (8.3, 0.1), "do NOT agree"),
        ((60.0, 1.0), (55.0, 4.0), "they agree"),
    ],
)
def test_comparison(seen, estimate, words):
    text = Comparison(2, *(arcmin2_to_rad2(area) for area in (*seen, *estimate))).text
    assert words in text
    assert f"{estimate[0]:.2f} +- {estimate[1]:.2f} arcmin2" in text


@pytest.mark.parametrize(
    ("uncertainty", "words"),
    [
        (0.002, "is 6.300 +- 0.002 arcmin2"),
        (1e-9, "is 6.3000 +- 0.0000 arcmin2"),
        (math.nan, "(uncertainty not stated)"),
    ],
)
def test_what_is_stated_of_an_estimate_is_told(uncertainty, words):
    found = Comparison(2, *(arcmin2_to_rad2(area) for area in (6.1, 0.05, 6.3, uncertainty)))
    assert words in found.text
    assert "they agree" in found.text
    assert found.sigmas == pytest.approx(-0.2 / math.hypot(0.05, 0.04 * 6.3), rel=1e-4)


def test_coma_of_a_star_off_the_axis_is_taken_off():
    """FACT, aligned, ray traced: 5.39 arcmin2 on the axis, 5.95 with the star 0.35 deg off (`namod-ctl raytrace`)."""
    rays = trace(REFLECTOR, 4000, deg_to_rad(np.array([0.21, 0.28])))
    light = combine_moments(facet_moments(rays))
    variances, axes = np.linalg.eigh(light.cov_m2 / REFLECTOR.focal_length_m**2)
    off_axis_px = -light.mean_m / REFLECTOR.focal_length_m / MODEL.plate_scale_rad
    area_rad2 = math.pi * math.sqrt(variances.prod())
    psf = Psf(
        a_sigma_rad2=area_rad2,
        a_sigma_uncertainty_rad2=0.01 * area_rad2,
        common_uncertainty_rad2=0.0,
        axes_rad=np.sqrt(variances[::-1]),
        axes_uncertainty_rad=np.zeros(2),
        angle_rad=math.atan2(axes[1, 1], axes[0, 1]) % math.pi,
        angle_uncertainty_rad=0.0,
        radii_rad=np.zeros(4),
        radii_uncertainty_rad=np.zeros(4),
        # an upright image, whose rows count downwards
        centre_px=MODEL.axis_pixel + off_axis_px * (-1.0, 1.0),
        centre_uncertainty_px=np.zeros(2),
        drift_px=np.zeros(2),
        n_images=1,
        scatter=math.nan,
        remarks=(),
    )
    centred = on_axis(psf, MODEL, REFLECTOR)
    assert area_rad2 > arcmin2_to_rad2(5.9)
    assert centred.a_sigma_rad2 == pytest.approx(arcmin2_to_rad2(5.39), rel=0.01)
    assert rad_to_deg(centred.off_axis_rad) == pytest.approx(0.35, rel=0.03)
    assert centred.uncertainty_rad2 > psf.a_sigma_uncertainty_rad2
