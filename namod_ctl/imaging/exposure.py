"""The exposure law: how long a camera should expose next, from the frame it has just taken.

One law for every camera. Solved for the exposure, the radiometric law (`radiometry`) says that light of constant
intensity gives a response that grows as ``T ** (-r_expo / r_resp)``; so one frame that shows the light neither
saturated nor lost in the noise tells the exposure that brings it to the target. A frame that shows too much or
nothing at all only bounds it: then the law jumps by `MAX_JUMP` in response, the range over which the next frame can
measure. Three such jumps cross the range of 1 ms to 3 s.

The law has no memory: it depends on the frame and its exposure only, as the telescope moves and clouds come and go.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.dark import QUANTISATION_NOISE_ADU
from namod_ctl.imaging.radiometry import N_COLOURS, Frame, checked_frame, saturation_adu
from namod_ctl.optics.camera_model import CameraModel

MAX_JUMP = 30.0
"""In response: 1/30 of the target, 7 of 255, can still be measured."""

MIN_LIGHT_SHARE = 0.02
"""Of full scale above the background: less light than this says too little about the exposure it needs."""

MIN_LIGHT_SIGMAS = 5.0

LOW_BACKGROUND_SHARE = 0.05
"""Of full scale: a background below is the camera's own offset, one above is sky that grows with the exposure."""

CAUTIOUS_FROM = 4.0
CAUTIOUS_SHARE = 0.6
"""From a response this many times too low, the aim is this share of the target: faint light is measured badly, and
a frame that is a little too dark is as good as one on target, while a saturated one is lost."""

SAMPLE_STEP = 16
"""The background is told by every 16th row and column: 19 000 pixels of the largest camera."""


class ExposureVerdict(StrEnum):
    """What a frame's exposure was."""

    GOOD = "good"
    SATURATED = "saturated"
    STARVED = "starved"


@dataclass(frozen=True, slots=True)
class ExposureRule:
    """What the law must know of a camera and of the wishes of its user.

    Attributes
    ----------
    response_per_exposure
        Exponent of the exposure in the response of constant light, -r_expo / r_resp.
    shortest_s, longest_s
        Limits of the exposure.
    target_share
        Share of full scale at which the brightest pixel is kept.
    min_share
        A frame whose brightest pixel has less is starved, unless it was exposed as long as can be.
    """

    response_per_exposure: float
    full_scale_adu: float
    saturation_adu: float
    shortest_s: float
    longest_s: float
    target_share: float = 0.8
    min_share: float = 0.2

    def clipped(self, exposure_s: float) -> float:
        """The exposure, within the limits."""
        return min(max(exposure_s, self.shortest_s), self.longest_s)


@dataclass(frozen=True, slots=True)
class FrameStatistics:
    """What the law must know of a frame.

    Attributes
    ----------
    brightest_adu
        Brightest pixel (of a colour frame: brightest channel) that does not shine alone, as a hot one does.
    background_adu, noise_adu
        Median of the pixels, and their robust standard deviation.
    n_saturated, n_half_saturated
        Pixels, hot ones left out, from saturation upwards, and from half of it; 0 when nothing is saturated.
    """

    brightest_adu: float
    background_adu: float
    noise_adu: float
    n_saturated: int = 0
    n_half_saturated: int = 0


def exposure_rule(
    camera: CameraModel, shortest_s: float, longest_s: float, target_share: float = 0.8, min_share: float = 0.2
) -> ExposureRule:
    """The rule of a camera.

    Raises
    ------
    ConfigError
        When the target lies not between the smallest accepted response and saturation, or the limits are none.
    """
    if not 0.0 < min_share < target_share < camera.saturation_share:
        raise ConfigError(
            f"camera {camera.name!r}: the brightest pixel is to be kept at {target_share:g} of full scale; it must lie "
            f"between {min_share:g} and the saturation at {camera.saturation_share:g}"
        )
    if not 0.0 < shortest_s <= longest_s:
        raise ConfigError(f"camera {camera.name!r}: exposures from {shortest_s:g} to {longest_s:g} s are no range")
    return ExposureRule(
        response_per_exposure=-camera.law.r_expo / camera.law.r_resp,
        full_scale_adu=camera.full_scale_adu,
        saturation_adu=saturation_adu(camera),
        shortest_s=shortest_s,
        longest_s=longest_s,
        target_share=target_share,
        min_share=min_share,
    )


def frame_statistics(frame: Frame, camera: CameraModel, region: NDArray[np.uint8] | None = None) -> FrameStatistics:
    """Statistics of a frame (rows, columns) or (rows, columns, 3) of the camera, 4 ms for the largest (`bench_record`).

    Single hot pixels, and two side by side, do not count: the brightest place is sought among the least values of 2 x 2
    pixels, and the brightest pixel then beside it.

    Parameters
    ----------
    region
        Shape (rows, columns), 0 where the light does not matter, the type's largest value (255) elsewhere.

    Raises
    ------
    ConfigError
        When the frame is not of the camera.
    """
    frame = checked_frame(frame, camera)
    if frame.ndim == N_COLOURS:
        blue, green, red = cv2.split(frame)
        frame = cv2.max(cv2.max(blue, green), red)
    sample = frame[SAMPLE_STEP // 2 :: SAMPLE_STEP, SAMPLE_STEP // 2 :: SAMPLE_STEP]
    if region is not None:
        sample = sample[region[SAMPLE_STEP // 2 :: SAMPLE_STEP, SAMPLE_STEP // 2 :: SAMPLE_STEP] > 0]
        frame = cv2.copyTo(frame, region)
    background_adu = float(np.median(sample)) if sample.size else 0.0
    spread_adu = 1.4826 * float(np.median(np.abs(sample - background_adu))) if sample.size else 0.0
    shared = cv2.erode(frame, np.ones((2, 2), dtype=np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    _, shared_adu, _, (x, y) = cv2.minMaxLoc(shared)
    # The value at (x, y) is the least of (x - 1, y - 1) to (x, y).
    around = frame[max(0, y - 2) : y + 2, max(0, x - 2) : x + 2]
    noise_adu = max(spread_adu, QUANTISATION_NOISE_ADU)
    brightest_adu = _brightest_but_hot(around, shared_adu, noise_adu)
    saturation = saturation_adu(camera)
    n_saturated = n_half = 0
    if brightest_adu >= saturation:
        n_saturated = int(np.count_nonzero(shared >= saturation))
        n_half = int(np.count_nonzero(shared >= 0.5 * saturation))
    return FrameStatistics(brightest_adu, background_adu, noise_adu, n_saturated, n_half)


def judge_exposure(statistics: FrameStatistics, exposure_s: float, rule: ExposureRule) -> ExposureVerdict:
    """Whether a frame was exposed well enough to be measured.

    A frame that could not have been exposed longer (or, when saturated, shorter) is good: that nothing shines is then
    the answer, and what saturates at the shortest exposure is for the measurement to reject.
    """
    if statistics.brightest_adu >= rule.saturation_adu:
        return ExposureVerdict.GOOD if exposure_s <= 1.01 * rule.shortest_s else ExposureVerdict.SATURATED
    is_starved = statistics.brightest_adu < rule.min_share * rule.full_scale_adu
    if is_starved and exposure_s < 0.99 * rule.longest_s:
        return ExposureVerdict.STARVED
    return ExposureVerdict.GOOD


def next_exposure_s(statistics: FrameStatistics, exposure_s: float, rule: ExposureRule) -> float:
    """The exposure, within the rule's limits, that brings the brightest pixel to the target."""
    target_adu = rule.target_share * rule.full_scale_adu
    light_adu = statistics.brightest_adu - statistics.background_adu
    least_adu = max(MIN_LIGHT_SHARE * rule.full_scale_adu, MIN_LIGHT_SIGMAS * statistics.noise_adu)
    growth = target_adu / max(statistics.brightest_adu, 1.0)
    if statistics.brightest_adu >= rule.saturation_adu:
        growth /= _excess(statistics)
    elif light_adu < least_adu and statistics.background_adu < LOW_BACKGROUND_SHARE * rule.full_scale_adu:
        # Invisible light has less than `least_adu`: a jump to the target of that cannot saturate it.
        growth = min(MAX_JUMP, target_adu / least_adu)
    elif growth > CAUTIOUS_FROM:
        growth *= CAUTIOUS_SHARE
    return rule.clipped(exposure_s * float(growth ** (1.0 / rule.response_per_exposure)))


def _excess(statistics: FrameStatistics) -> float:
    """How many times saturation the brightest pixel would show, 1 to `MAX_JUMP`.

    A gaussian's area above a level is linear in the level's logarithm, so the areas above saturation and above half of
    it tell the height of its cut-off top. Where whole facets shine, both areas are alike, and the answer is "a lot".
    """
    rim = statistics.n_half_saturated - statistics.n_saturated
    doublings = statistics.n_saturated / max(rim, 1)
    return float(min(2.0 ** min(doublings, 10.0), MAX_JUMP))


def _brightest_but_hot(around: Frame, shared_adu: float, noise_adu: float) -> float:
    """Largest value of a few pixels around a bright place, without one that stands above the others as no light can.

    From the peak of the sharpest star to its second pixel the light falls 2.5 times as far as from there to the least
    of its 2 x 2 pixels; on an evenly lit facet all these are alike, and a hot pixel is steeper.
    """
    second_adu, first_adu = np.partition(around.astype(np.float64).ravel(), -2)[-2:]
    is_hot = first_adu - second_adu > 3.0 * (second_adu - shared_adu) + MIN_LIGHT_SIGMAS * noise_adu
    return float(second_adu if is_hot else first_adu)
