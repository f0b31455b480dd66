"""The star finder: exactly one dominant star in a frame, measured, or the reason why there is none.

A star counts when
- its peak stands `MIN_SIGMAS` above the noise of the pixels around it and has at least `MIN_PEAK_SHARE` of full scale,
- its diameter is `MIN_DIAMETER` to `MAX_DIAMETER` times the size the config gives (and never below
  `SHARPEST_STAR_PX`: sharper light cannot be told from a hot pixel). Diameter: full width at half maximum of the
  gaussian that matches, geometric mean of both axes,
- it is at most `MAX_ELONGATION` times as long as wide,
- no pixel of its aperture is saturated and the aperture lies wholly in the frame,
- no other spot has more than `DOMINANCE_SHARE` of its peak.
Single hot pixels neither make a star nor hide one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.imaging.radiometry import Frame, response_table, saturation_adu
from namod_ctl.imaging.star_candidates import MAX_SPOT_SHARE, FirstLook, Spot, first_look
from namod_ctl.imaging.star_profile import Profile, measure_profile
from namod_ctl.optics.camera_model import CameraModel

MIN_SIGMAS = 5.0
"""arXiv:1605.06274, section 3: a star stands 5 sigma above the noise."""

MIN_PEAK_SHARE = 0.03
"""Of full scale: 8 of 255. Below, the steps of an 8 bit camera swallow more than a tenth of the star's light."""

MIN_DIAMETER = 0.25
MAX_DIAMETER = 3.0
SHARPEST_STAR_PX = 1.75
MAX_ELONGATION = 2.0

DOMINANCE_SHARE = 0.2
"""A second star with more than a fifth of the first one's peak (1.7 magnitudes fainter) makes both doubtful: its light
falls on the facets at another direction. One of a tenth does not count."""

APERTURE_RADIUS = 2.0
"""Of the star's size in the config: 99.99 % of a gaussian's light, 95 % of a Moffat profile's (beta = 2.5)."""

APERTURE_RADIUS_OF_BROAD_STAR = 1.5
"""Of the diameter that is seen, where this is more: a star out of focus keeps its light."""

SMALLEST_APERTURE_PX = 6.0
"""Radius: a smaller one leaves too few pixels around it for the background."""

SMALLEST_FRAME = 4.0
"""Of the aperture's radius: width or height of a frame with room for an aperture and some sky."""

STREAK_ELONGATION = 3.0
STREAK_LENGTH = 4.0
"""Times the star's size: what is longer and three times longer than wide in the first look is a streak."""

HUGE_DIAMETER = 1.5 * MAX_DIAMETER
"""Times the star's size: what is larger in the first look is not measured any further."""


@dataclass(frozen=True, slots=True)
class Star:
    """The one star of a frame.

    Attributes
    ----------
    x_px, y_px
        Centre of its light, (column, row).
    uncertainty_px
        One standard deviation of each axis of the centre.
    intensity_sum
        Sum of C**r_resp over the aperture less the background's; times `radiometry.exposure_factor` its intensity.
    diameter_px
        Full width at half maximum.
    peak_adu, noise_adu
        Height above the background, and standard deviation of one pixel of that.
    """

    x_px: float
    y_px: float
    uncertainty_px: float
    intensity_sum: float
    diameter_px: float
    peak_adu: float
    noise_adu: float


@dataclass(frozen=True, slots=True)
class StarRejection:
    """Why a frame has no star that counts, and what a person should know about it."""

    reason: RejectReason
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class StarFinder:
    """What the finder must know of a camera.

    Attributes
    ----------
    star_size_px
        Diameter of a star's image.
    full_scale_adu, saturation_adu
        Largest response, and from which one on a pixel counts as saturated.
    table
        `radiometry.response_table` of the camera.
    """

    star_size_px: float
    full_scale_adu: float
    saturation_adu: float
    table: NDArray[np.float64]

    def find(self, frame: Frame) -> Star | StarRejection:
        """The star of a frame (rows, columns), or why there is none that counts.

        Raises
        ------
        ConfigError
            When the frame is too small for stars of this size.
        """
        if min(frame.shape) < SMALLEST_FRAME * self._aperture_px(0.0):
            raise ConfigError(
                f"a star frame of {frame.shape[1]} x {frame.shape[0]} pixel is too small for stars of "
                f"{self.star_size_px:.1f} pixel: correct star_size, the plate scale or the size of the image"
            )
        look = first_look(frame, self.star_size_px, self.full_scale_adu, fainter_share=0.5 * DOMINANCE_SHARE)
        if look.sky_adu >= self.saturation_adu:
            return StarRejection(
                RejectReason.STAR_SATURATED,
                f"the sky itself is saturated ({look.sky_adu:.0f} of {self.full_scale_adu:.0f})",
            )
        if look.bright_share > MAX_SPOT_SHARE:
            return StarRejection(
                RejectReason.STAR_TOO_LARGE,
                f"{look.bright_share:.0%} of the frame stands above its background (limit {MAX_SPOT_SHARE:.0%})",
            )
        star: Profile | None = None
        passed_over: StarRejection | None = None
        for spot in look.spots:
            found = self._examined(frame, spot)
            if isinstance(found, Profile):
                if star is not None and not _is_same(found, star) and _is_comparable(found.peak_adu, star.peak_adu):
                    return _several(star, found)
                star = star or found
            elif found.reason in (RejectReason.NO_STAR, RejectReason.STAR_TOO_SMALL):
                passed_over = passed_over or found
            elif star is None or _is_comparable(spot.peak_adu, star.peak_adu):
                return found
        if star is None:
            return passed_over or self._nothing(look)
        return self._reason_against(frame, star) or Star(
            x_px=star.x_px,
            y_px=star.y_px,
            uncertainty_px=star.uncertainty_px,
            intensity_sum=star.intensity_sum,
            diameter_px=star.diameter_px,
            peak_adu=star.peak_adu,
            noise_adu=star.noise_adu,
        )

    def _nothing(self, look: FirstLook) -> StarRejection:
        if look.n_isolated:
            return StarRejection(
                RejectReason.STAR_TOO_SMALL,
                f"nothing but {look.n_isolated} single shining pixel(s), one near x = {look.isolated_px[0]}, "
                f"y = {look.isolated_px[1]}",
            )
        return StarRejection(
            RejectReason.NO_STAR,
            f"nothing stands {MIN_SIGMAS:g} sigma above the noise of {look.noise_adu:.2f} "
            f"at a sky of {look.sky_adu:.0f} (full scale {self.full_scale_adu:.0f})",
        )

    def _examined(self, frame: Frame, spot: Spot) -> Profile | StarRejection:
        """The profile of a spot that could be a star, or why it could not."""
        where = f"at x = {spot.x_px:.0f}, y = {spot.y_px:.0f}"
        if spot.elongation > STREAK_ELONGATION and spot.length_px > STREAK_LENGTH * self.star_size_px:
            return StarRejection(
                RejectReason.STAR_STREAK,
                f"a streak {where}, {spot.length_px:.0f} pixel long and {spot.elongation:.1f} times longer than wide",
            )
        if spot.diameter_px > HUGE_DIAMETER * self.star_size_px:
            if spot.brightest_adu >= self.saturation_adu:
                return StarRejection(
                    RejectReason.STAR_SATURATED, f"saturated light {where}, {spot.diameter_px:.0f} pixel wide"
                )
            return self._too_large(where, spot.diameter_px)
        profile = measure_profile(
            frame, spot.x_px, spot.y_px, spot.diameter_px, self._aperture_px(spot.diameter_px), self.table
        )
        if profile.peak_adu < MIN_SIGMAS * profile.noise_adu:
            return StarRejection(
                RejectReason.NO_STAR,
                f"the brightest spot {where} stands {profile.peak_adu / profile.noise_adu:.1f} sigma above the noise "
                f"of {profile.noise_adu:.2f} (limit {MIN_SIGMAS:g})",
            )
        smallest_px = max(MIN_DIAMETER * self.star_size_px, SHARPEST_STAR_PX)
        if profile.diameter_px < smallest_px:
            return StarRejection(
                RejectReason.STAR_TOO_SMALL,
                f"the spot {where} is {profile.diameter_px:.1f} pixel wide (limit {smallest_px:.1f})",
            )
        return profile

    def _aperture_px(self, diameter_px: float) -> float:
        """Radius of the aperture for a star that looks `diameter_px` wide."""
        of_size, of_broad = APERTURE_RADIUS * self.star_size_px, APERTURE_RADIUS_OF_BROAD_STAR * diameter_px
        return max(of_size, of_broad, SMALLEST_APERTURE_PX)

    def _reason_against(self, frame: Frame, star: Profile) -> StarRejection | None:
        """What stands against the dominant star of a frame."""
        where = f"the star at x = {star.x_px:.1f}, y = {star.y_px:.1f}"
        n_rows, n_columns = frame.shape
        to_edge_px = min(star.x_px, star.y_px, n_columns - 1 - star.x_px, n_rows - 1 - star.y_px)
        if star.brightest_adu >= self.saturation_adu:
            return StarRejection(
                RejectReason.STAR_SATURATED,
                f"{where} reaches {star.brightest_adu:.0f} (saturated from {self.saturation_adu:.0f}): "
                "shorten the exposure",
            )
        if star.companion_share > DOMINANCE_SHARE:
            return StarRejection(
                RejectReason.SEVERAL_STARS,
                f"{where} has a companion with {star.companion_share:.0%} of its peak beside it "
                f"(limit {DOMINANCE_SHARE:.0%})",
            )
        if to_edge_px < star.aperture_px:
            return StarRejection(
                RejectReason.STAR_AT_EDGE,
                f"{where} is {max(to_edge_px, 0.0):.0f} pixel from the edge (limit {star.aperture_px:.0f})",
            )
        if star.elongation > MAX_ELONGATION:
            return StarRejection(
                RejectReason.STAR_STREAK,
                f"{where} is {star.elongation:.1f} times longer than wide (limit {MAX_ELONGATION:g})",
            )
        if star.diameter_px > MAX_DIAMETER * self.star_size_px:
            return self._too_large(where, star.diameter_px)
        if star.peak_adu < MIN_PEAK_SHARE * self.full_scale_adu:
            return StarRejection(
                RejectReason.STAR_UNDEREXPOSED,
                f"{where} rises {star.peak_adu:.1f} above the background "
                f"(limit {MIN_PEAK_SHARE * self.full_scale_adu:.1f}): lengthen the exposure",
            )
        return None

    def _too_large(self, where: str, diameter_px: float) -> StarRejection:
        return StarRejection(
            RejectReason.STAR_TOO_LARGE,
            f"{where}: {diameter_px:.0f} pixel wide (limit {MAX_DIAMETER * self.star_size_px:.0f})",
        )


def star_finder(camera: CameraModel, star_size_rad: float, dtype: np.dtype[Any], rest_adu: float = 0.0) -> StarFinder:
    """The finder for frames of that type of a camera in which a star is `star_size_rad` wide.

    `rest_adu` is what the frames still show without light (`dark.dark_rest_adu`).
    """
    return StarFinder(
        star_size_px=star_size_rad / camera.plate_scale_rad,
        full_scale_adu=camera.full_scale_adu,
        saturation_adu=saturation_adu(camera),
        table=response_table(camera, dtype, rest_adu),
    )


def _is_comparable(peak_adu: float, other_adu: float) -> bool:
    return min(peak_adu, other_adu) > DOMINANCE_SHARE * max(peak_adu, other_adu)


def _is_same(found: Profile, star: Profile) -> bool:
    """True when a faint spot beside a star led the measurement to the star itself."""
    return math.hypot(found.x_px - star.x_px, found.y_px - star.y_px) < 0.5 * star.diameter_px


def _several(star: Profile, other: Profile) -> StarRejection:
    return StarRejection(
        RejectReason.SEVERAL_STARS,
        f"stars at x = {star.x_px:.0f}, y = {star.y_px:.0f} and x = {other.x_px:.0f}, y = {other.y_px:.0f} "
        f"with peaks of {star.peak_adu:.0f} and {other.peak_adu:.0f} (limit: the second has {DOMINANCE_SHARE:.0%})",
    )
