"""The sensor of a camera: the radiometric law inverted to digital numbers, noise, hot pixels, saturation, blooming.

Intensities here are those of the radiometric law. A light's mean response is exactly what the law inverts to; noise is
added before rounding, so rounding adds no bias where the response is above some noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import CameraSettings

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
Image = NDArray[np.unsignedinteger[Any]]

BRIGHT_SHARE = 0.8
"""Of full scale: what the exposures of `CameraSettings.exposure_at_mag0_s` lead to."""
N_QUANTILES = 256
MAX_BLOOM_PX = 200
HOT_ADU_PER_S = 20.0
"""Median of the hot pixels' dark responses; they scatter by a factor e."""

NORMAL_QUANTILES = ndtri((np.arange(N_QUANTILES) + 0.5) / N_QUANTILES)
NORMAL_QUANTILES /= NORMAL_QUANTILES.std()


class Sensor:
    """What turns light into digital numbers in one camera."""

    def __init__(self, camera: CameraModel, settings: CameraSettings, name: str, seed: int) -> None:
        self.camera = camera
        self.settings = settings
        self._name = name
        self._seed = seed
        self.law = _true_law(camera.law, settings)
        self.bright_intensity = _intensity(camera.law, BRIGHT_SHARE, settings.exposure_at_mag0_s)
        self.dtype = np.dtype(np.uint8 if camera.full_scale_adu <= 255 else np.uint16)
        self._hot_index, self._hot_adu_per_s = self._draw_hot(settings.n_hot_pixels, HOT_ADU_PER_S, 0)

    def response_factor(self, exposure_s: float) -> float:
        """k of adu = k * intensity^(1 / r_resp) at that exposure."""
        law = self.law
        log_share = (-law.r_expo * math.log10(exposure_s) - law.r_const) / law.r_resp
        return float(self.camera.full_scale_adu * 10.0**log_share)

    def response(self, intensity: Floats, exposure_s: float) -> Floats:
        """Mean response in adu above the black level, not limited by saturation; any shape."""
        mean: Floats = self.response_factor(exposure_s) * np.maximum(intensity, 0.0) ** (1.0 / self.law.r_resp)
        return mean

    def noise_adu(self, mean_adu: Floats) -> Floats:
        """Standard deviation of a pixel with that mean response above the black level."""
        s = self.settings
        sigma: Floats = np.sqrt(s.read_noise_adu**2 + mean_adu / s.electrons_per_adu)
        return sigma

    def digitized(self, mean_adu: Floats, normal: Floats) -> Image:
        """Digital numbers of pixels with these mean responses and standard normal deviates; same shape."""
        adu = self.settings.black_level_adu + mean_adu + self.noise_adu(mean_adu) * normal
        return np.asarray(np.clip(np.rint(adu), 0.0, self.camera.full_scale_adu), dtype=self.dtype)

    def quantile_tables(self, mean_adu: Floats) -> Image:
        """Digital numbers of the `N_QUANTILES` quantiles of noise about mean responses (n,); shape (n, N_QUANTILES)."""
        return self.digitized(mean_adu[:, None], NORMAL_QUANTILES)

    def shine_hot(self, image: Image, exposure_s: float, more: list[tuple[int, int, float]]) -> None:
        """Add the hot pixels to an image, in place; `more` of faults: (number, count, adu per s)."""
        hot = [(self._hot_index, self._hot_adu_per_s)]
        hot += [self._draw_hot(count, adu_per_s, number + 1) for number, count, adu_per_s in more]
        flat = image.reshape(self.camera.n_rows * self.camera.n_columns, -1)
        for index, adu_per_s in hot:
            adu = flat[index] + (adu_per_s * exposure_s)[:, None]
            flat[index] = np.minimum(np.rint(adu), self.camera.full_scale_adu).astype(self.dtype)

    def bloomed(self, mean_adu: Floats) -> Floats:
        """Responses (rows, columns) of which those above full scale spill a share along their columns."""
        full = self.camera.full_scale_adu
        excess = np.maximum(mean_adu - full, 0.0).sum(axis=0) * self.settings.blooming_share
        spilled = np.array(mean_adu)
        for column in np.flatnonzero(excess >= full):
            rows = np.flatnonzero(mean_adu[:, column] >= full)
            n = min(int(excess[column] / full / 2.0), MAX_BLOOM_PX)
            spilled[max(rows[0] - n, 0) : rows[-1] + n + 1, column] = np.maximum(
                full, spilled[max(rows[0] - n, 0) : rows[-1] + n + 1, column]
            )
        return spilled

    def _draw_hot(self, count: int, adu_per_s: float, number: int) -> tuple[NDArray[np.intp], Array]:
        rng = generator(self._seed, f"hot pixels of {self._name}", number)
        n_pixels = self.camera.n_rows * self.camera.n_columns
        count = min(count, n_pixels)
        index = rng.choice(n_pixels, size=count, replace=False, shuffle=False)
        return index.astype(np.intp), adu_per_s * np.exp(rng.standard_normal(count))


def _intensity(law: RadiometricLaw, share: float, exposure_s: float) -> float:
    return float(10.0 ** (law.r_resp * math.log10(share) + law.r_expo * math.log10(exposure_s) + law.r_const))


def _true_law(law: RadiometricLaw, settings: CameraSettings) -> RadiometricLaw:
    """The law the hardware follows: the config's, or one that makes the wanted error when the config's is used.

    At constant response the recovered log I is r_expo log T, the true one r_expo' log T: their ratio 1 + e makes the
    recovered intensity wrong by 10^e per decade. Both laws agree at the exposure for magnitude 0.
    """
    if settings.law_error_per_decade == 0.0:
        return law
    r_expo = law.r_expo / (1.0 + math.log10(1.0 + settings.law_error_per_decade))
    r_const = law.r_const + (law.r_expo - r_expo) * math.log10(settings.exposure_at_mag0_s)
    return RadiometricLaw(law.r_resp, r_expo, r_const)
