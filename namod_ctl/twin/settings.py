"""What the twin is made of: its physics as numbers, with defaults that make a telescope like FACT on a clear night."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

from namod_ctl.core.units import arcmin_to_rad, arcsec_to_rad, deg_to_rad, mm_to_m

STRICT: dict[str, Any] = {"extra": "forbid", "allow_inf_nan": False}
"""How pydantic reads these settings from a file: unknown keys and numbers that are none are mistakes."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The least and the largest value of a setting for which the twin's physics makes sense."""

    least: float
    most: float


ANGLE = Limits(0.0, deg_to_rad(5.0))
"""Of surfaces and images: a telescope whose facets are further off throws no light into its camera."""
SHARE = Limits(0.0, 1.0)

FACT_APERTURE_RAD = mm_to_m(1.7) / 4.889
"""Radius of the reflector camera's lens as seen from the dish: 1.7 mm at FACT's 4.889 m."""


@dataclass(frozen=True, slots=True)
class ReflectorSettings:
    """How far the true facets are from the config's.

    Attributes
    ----------
    misalignment_rad
        Standard deviation per axis of the facets' images in the focal plane: twice that of their tilts.
    figure_blur_rad
        Spread of each low-order figure error (two astigmatisms, two comas, two trefoils) as blur of the image at the
        facet's rim.
    focal_length_spread
        Standard deviation of the facets' focal lengths, relative.
    roughness_rad, roughness_spread
        Standard deviation of the surface's slope per axis, and its relative scatter between facets.
    reflectivity, reflectivity_spread
        Mean and standard deviation over the facets.
    sag_rad
        Mean tilt by which facets sink towards the dish's lower rim when the telescope turns from zenith to horizon.
    sag_hysteresis_rad
        Half of the zenith distance that the telescope must turn back before the sag follows.
    drift_rad_per_kelvin
        Standard deviation per axis of the facets' tilt per degree of temperature.
    cooling_kelvin_per_hour
        How fast the night cools the dish.
    bending_rad
        Tilt by which the outermost facets turn outwards when the telescope turns from zenith to horizon, as the weight
        along the axis goes; those further in turn less, in proportion. A fifth of it differs from facet to facet.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    misalignment_rad: Annotated[float, ANGLE] = arcmin_to_rad(4.0)
    figure_blur_rad: Annotated[float, ANGLE] = deg_to_rad(0.008)
    focal_length_spread: Annotated[float, Limits(0.0, 0.2)] = 0.003
    roughness_rad: Annotated[float, ANGLE] = arcsec_to_rad(16.0)
    roughness_spread: Annotated[float, SHARE] = 0.2
    reflectivity: Annotated[float, Limits(0.01, 1.0)] = 0.85
    reflectivity_spread: Annotated[float, Limits(0.0, 0.5)] = 0.03
    sag_rad: Annotated[float, ANGLE] = arcmin_to_rad(0.15)
    sag_hysteresis_rad: Annotated[float, Limits(0.0, deg_to_rad(90.0))] = deg_to_rad(2.0)
    drift_rad_per_kelvin: Annotated[float, ANGLE] = arcmin_to_rad(0.02)
    cooling_kelvin_per_hour: Annotated[float, Limits(-20.0, 20.0)] = 0.5
    bending_rad: Annotated[float, ANGLE] = 0.0


PERFECT = ReflectorSettings(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Facets exactly as the config says, perfectly aligned and stiff."""


@dataclass(frozen=True, slots=True)
class SkySettings:
    """The night.

    Attributes
    ----------
    reference_star
        Name in `namod_ctl.twin.sky.CATALOGUE`.
    star_changes
        Moments (s on the twin's clock) from which on the telescope follows another star of the catalogue.
    latitude_rad, altitude_m
        Of the observatory: La Palma.
    sidereal_time_rad
        Local sidereal time at the clock's zero; with it the star's zenith distance.
    extinction_mag
        Loss of light at zenith.
    scintillation
        Strength relative to Young's formula; 0 for a calm sky.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    reference_star: str = "Vega"
    star_changes: tuple[tuple[float, str], ...] = ()
    latitude_rad: Annotated[float, Limits(deg_to_rad(-90.0), deg_to_rad(90.0))] = deg_to_rad(28.76)
    altitude_m: Annotated[float, Limits(-500.0, 9000.0)] = 2200.0
    sidereal_time_rad: Annotated[float, Limits(deg_to_rad(-360.0), deg_to_rad(720.0))] = deg_to_rad(255.0)
    extinction_mag: Annotated[float, Limits(0.0, 5.0)] = 0.12
    scintillation: Annotated[float, Limits(0.0, 100.0)] = 1.0


@dataclass(frozen=True, slots=True)
class TelescopeSettings:
    """How the telescope wanders around the star; the recorder knows nothing of it.

    Attributes
    ----------
    pattern
        Path of the star over the telescope's field of view.
    radius_rad
        How far from `centre_rad` the star gets.
    spacing_rad
        Between neighbouring turns of the spiral or lines of the raster; a random path is as long.
    speed_rad_per_s
        Mean speed along the path.
    jitter_rad
        Standard deviation per axis of the drives' tracking error.
    slew_s
        How long a change of star takes; meanwhile no star is in the field.
    came_from_zenith_rad
        Zenith distance of the park position from which the telescope turned to its first star.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    pattern: Literal["spiral", "random", "raster"] = "spiral"
    radius_rad: Annotated[float, Limits(arcmin_to_rad(0.1), deg_to_rad(5.0))] = deg_to_rad(0.35)
    centre_rad: Annotated[tuple[float, float], Limits(deg_to_rad(-5.0), deg_to_rad(5.0))] = (0.0, 0.0)
    spacing_rad: Annotated[float, Limits(arcsec_to_rad(1.0), deg_to_rad(5.0))] = arcmin_to_rad(1.0)
    speed_rad_per_s: Annotated[float, Limits(arcsec_to_rad(0.01), deg_to_rad(5.0))] = arcmin_to_rad(1.0)
    jitter_rad: Annotated[float, Limits(0.0, deg_to_rad(1.0))] = arcmin_to_rad(0.03)
    slew_s: Annotated[float, Limits(0.0, 3600.0)] = 10.0
    came_from_zenith_rad: Annotated[float, Limits(0.0, deg_to_rad(90.0))] = 0.0


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """The hardware of one camera, beyond its calibration.

    Attributes
    ----------
    exposure_at_mag0_s
        Exposure at which a star of magnitude 0 at zenith fills `BRIGHT_SHARE` of full scale.
    read_noise_adu, electrons_per_adu
        Noise of a dark pixel, and the gain that sets the shot noise.
    background_share
        Dark sky (or the scene), relative to the brightest pixel that a star of magnitude 0 makes.
    black_level_adu
        Response without light. The radiometric law knows none, so it is 0 unless a dark frame is to be needed.
    law_error_per_decade
        How wrong the config's calibration is: relative change of the recovered intensity per decade of light, at
        constant response. The paper's hardware: 0.172.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    exposure_at_mag0_s: Annotated[float, Limits(1e-5, 100.0)]
    background_share: Annotated[float, SHARE]
    read_noise_adu: Annotated[float, Limits(0.0, 100.0)] = 0.6
    electrons_per_adu: Annotated[float, Limits(0.01, 1e6)] = 40.0
    black_level_adu: Annotated[float, Limits(0.0, 1e4)] = 0.0
    n_hot_pixels: Annotated[int, Limits(0, 1_000_000)] = 60
    blooming_share: Annotated[float, SHARE] = 0.1
    exposure_range_s: Annotated[tuple[float, float], Limits(1e-5, 60.0)] = (0.001, 3.0)
    exposure_step_s: Annotated[float, Limits(1e-7, 0.1)] = 5e-5
    latency_s: Annotated[float, Limits(0.0, 1.0)] = 0.015
    law_error_per_decade: Annotated[float, Limits(-0.5, 5.0)] = 0.0


# A dark sky has 21.5 magnitudes per square arcsec: 17 in a pixel of the star camera, of which a star's brightest holds
# 1 %; 11 in the lens of the reflector camera as a mirror shows it, and the scene beside the mirrors is little brighter.
STAR_CAMERA = CameraSettings(exposure_at_mag0_s=0.05, background_share=3e-5)
REFLECTOR_CAMERA = CameraSettings(exposure_at_mag0_s=0.25, background_share=1e-4)


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """One fault of `namod_ctl.twin.faults.CATALOGUE` and when it happens; without an end it stays."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    start_s: Annotated[float, Limits(0.0, 1e7)] = 0.0
    duration_s: Annotated[float | None, Limits(1e-3, 1e7)] = None
    params: Mapping[str, float | str] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True)
class TwinSettings:
    """All of it.

    Attributes
    ----------
    aperture_radius_m
        Radius of the reflector camera's lens; None: as large as FACT's for this focal length.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    reflector: ReflectorSettings = ReflectorSettings()
    sky: SkySettings = SkySettings()
    telescope: TelescopeSettings = TelescopeSettings()
    star_camera: CameraSettings = STAR_CAMERA
    reflector_camera: CameraSettings = REFLECTOR_CAMERA
    aperture_radius_m: Annotated[float | None, Limits(mm_to_m(0.01), 1.0)] = None
    faults: tuple[FaultSpec, ...] = ()
