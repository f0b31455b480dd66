"""Where the lamp lights a frame, and what is measured there, on drawn frames."""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.calibration.lamp.dark_frames import DarkFrame
from namod_ctl.calibration.lamp.lamp_series import (
    at_distance,
    lit_patch,
    measure_response,
    middle_of,
    patch_dark,
    refuse_wandering,
    without_hot,
)
from namod_ctl.core.errors import DataQualityError

ROWS, COLUMNS = 120, 160


def disc(row: float, column: float, radius: float, adu: float, dark: float = 5.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    light = np.where((y - row) ** 2 + (x - column) ** 2 < radius**2, adu, 0.0)
    return np.clip(np.rint(dark + light + 0.8 * rng.standard_normal(light.shape)), 0, 255).astype(np.uint8)


def test_patch_lies_within_the_lit_disc() -> None:
    image = disc(60, 80, 30, 150.0)
    patch = lit_patch(image, 5.0, 255.0, "frame")
    y, x = np.nonzero(patch.is_inside)
    assert np.hypot(y - 60, x - 80).max() < 30.0
    assert patch.n_pixels > 0.75 * np.pi * 30.0**2
    response = measure_response(image, patch, 255.0, "frame", 0, 0.1, 0.0)
    assert response.mean_adu[0] == pytest.approx(155.0, abs=0.1)
    assert response.noise_adu[0] == pytest.approx(np.hypot(0.8, 12.0**-0.5), rel=0.05)


def test_large_patch_is_measured_in_its_middle() -> None:
    patch = lit_patch(np.full((900, 1200), 150, np.uint8), 5.0, 255.0, "frame")
    inner = middle_of(patch)
    y, x = np.nonzero(inner.is_inside)
    assert inner.n_pixels == 500**2
    assert (y.mean(), x.mean()) == pytest.approx((449.5, 599.5), abs=1.0)
    small = lit_patch(disc(60, 80, 30, 150.0), 5.0, 255.0, "frame")
    assert np.array_equal(middle_of(small).is_inside, small.is_inside)


def test_points_of_light_and_darkness_are_no_lamp() -> None:
    with pytest.raises(DataQualityError, match="put a diffuser"):
        lit_patch(disc(60, 80, 7, 200.0), 5.0, 255.0, "frame")
    with pytest.raises(DataQualityError, match="hardly to be seen"):
        lit_patch(disc(60, 80, 30, 3.0), 5.0, 255.0, "frame")


def test_lamp_that_shrinks_or_moves_is_refused() -> None:
    patch = lit_patch(disc(60, 80, 40, 150.0), 5.0, 255.0, "near")
    refuse_wandering(patch, lit_patch(disc(61, 80, 41, 100.0), 5.0, 255.0, "far"), at_distance(2.0))
    for other in (disc(60, 80, 25, 150.0), disc(60, 110, 40, 150.0)):
        with pytest.raises(DataQualityError, match="2 m: the lamp lights only"):
            refuse_wandering(patch, lit_patch(other, 5.0, 255.0, "far"), at_distance(2.0))


def test_hot_pixels_and_cosmic_rays_change_no_response() -> None:
    patch = lit_patch(disc(60, 80, 30, 150.0), 5.0, 255.0, "frame")
    hot = [(50, 70), (61, 90), (70, 80)]
    darks = []
    for number in range(3):
        image = disc(60, 80, 30, 0.0, seed=number + 1)
        for place in hot:
            image[place] = 90
        darks.append(DarkFrame(f"dark {number}", image, 1.0))
    cool = without_hot(patch, darks)
    assert patch.n_pixels - cool.n_pixels == len(hot)
    frame = disc(60, 80, 30, 40.0)
    honest = measure_response(frame, cool, 255.0, "frame", 0, 1.0, 0.0)
    for place in hot:
        frame[place] = 200
    frame[55, 80:84] = 180  # a cosmic ray
    found = measure_response(frame, cool, 255.0, "frame", 0, 1.0, 0.0)
    assert found.mean_adu[0] == pytest.approx(honest.mean_adu[0], abs=0.005)
    assert patch_dark(darks, cool).level_adu(1.0)[0] == pytest.approx(5.0, abs=0.02)
