"""The twin's lamp bench keeps to the law of the paper, put in as numbers here."""

from __future__ import annotations

import math

import numpy as np
import pytest

from namod_ctl.core.errors import CommunicationError, LimitError
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.lamp import LampSettings, TwinLamp
from namod_ctl.twin.settings import CameraSettings

STEADY = LampSettings(intensity_at_1m=2.0, flicker_share=0.0, fall_off_share=0.0)


def lamp(
    settings: LampSettings = STEADY,
    law: RadiometricLaw = RadiometricLaw(1.2, -1.23, 0.99),  # noqa: B008 - frozen
    size: tuple[int, int] = (64, 48),
    n_channels: int = 1,
) -> TwinLamp:
    columns, rows = size
    axis = np.array([columns / 2.0, rows / 2.0])
    model = CameraModel("bench", columns, rows, 1e-4, axis, False, CameraOrientation(0.0, False), law)
    return TwinLamp(model, CameraSettings(0.05, 1e-4, n_hot_pixels=0), settings, law, 1, n_channels)


def mean_share(bench: TwinLamp, exposure_s: float) -> float:
    bench.start(exposure_s)
    return float(bench.fetch(2.0).image.mean()) / 255.0


@pytest.mark.parametrize("r_curve", [0.0, 0.08, -0.05])
@pytest.mark.parametrize(("distance_m", "exposure_s"), [(1.0, 1.0), (0.5, 0.4), (2.0, 2.9)])
def test_mean_response_follows_the_law(r_curve: float, distance_m: float, exposure_s: float) -> None:
    bench = lamp(law=RadiometricLaw(1.2, -1.23, 0.99, r_curve))
    bench.place(distance_m)
    x = math.log10(mean_share(bench, exposure_s))
    log_intensity = 1.2 * x + r_curve * x**2 - 1.23 * math.log10(exposure_s) + 0.99
    assert 10.0**log_intensity == pytest.approx(2.0 / distance_m**2, rel=2e-3)


def test_cap_takes_the_light_and_levels_share_it() -> None:
    bench = lamp()
    bench.set_level(1.0)
    bright = mean_share(bench, 1.0)
    bench.set_level(0.25)
    assert mean_share(bench, 1.0) == pytest.approx(bright * 0.25 ** (1.0 / 1.2), rel=2e-3)
    bench.cap()
    assert mean_share(bench, 3.0) < 0.3 / 255.0


def test_drift_and_time_pass_together() -> None:
    bench = lamp(LampSettings(intensity_at_1m=2.0, flicker_share=0.0, fall_off_share=0.0, drift_share_per_hour=0.2))
    bench.place(1.0)
    first = mean_share(bench, 1.0)
    bench.clock.wait_s(3600.0)
    assert mean_share(bench, 1.0) == pytest.approx(first * math.exp(0.2 / 1.2), rel=2e-3)


def test_large_frames_share_noise_but_not_frames() -> None:
    bench = lamp(size=(640, 480))
    bench.place(1.0)
    images = []
    for _ in range(2):
        bench.start(0.5)
        images.append(bench.fetch(2.0).image.astype(float))
    difference = images[0] - images[1]
    assert difference.std() == pytest.approx(math.sqrt(2.0) * images[0].std(), rel=0.02)


def test_colours_average_to_the_intensity() -> None:
    bench = lamp(n_channels=3)
    bench.place(1.0)
    bench.start(1.0)
    share = bench.fetch(2.0).image.reshape(-1, 3).mean(axis=0) / 255.0
    assert np.mean(share**1.2) * 10.0**0.99 == pytest.approx(2.0, rel=2e-3)


def test_exposures_it_cannot_make() -> None:
    bench = lamp()
    with pytest.raises(LimitError):
        bench.start(1e-5)
    with pytest.raises(CommunicationError):
        bench.fetch(1.0)
