"""Conversions between SI (inside) and the units of people, configs and wires (outside).

Every function takes and returns a float or an array of any shape.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", float, NDArray[np.float64])

_RAD_PER_DEG = math.pi / 180.0
_RAD_PER_ARCMIN = _RAD_PER_DEG / 60.0


def deg_to_rad(angle_deg: T) -> T:
    """Degrees as radians."""
    return angle_deg * _RAD_PER_DEG


def rad_to_deg(angle_rad: T) -> T:
    """Radians as degrees."""
    return angle_rad / _RAD_PER_DEG


def mdeg_to_rad(angle_mdeg: T) -> T:
    """Thousandths of a degree (plate scales of cameras in configs) as radians."""
    return angle_mdeg / 1000.0 * _RAD_PER_DEG


def rad_to_mdeg(angle_rad: T) -> T:
    """Radians as thousandths of a degree (plate scales of cameras in configs)."""
    return angle_rad / _RAD_PER_DEG * 1000.0


def arcmin_to_rad(angle_arcmin: T) -> T:
    """Minutes of arc as radians."""
    return angle_arcmin * _RAD_PER_ARCMIN


def rad_to_arcmin(angle_rad: T) -> T:
    """Radians as minutes of arc."""
    return angle_rad / _RAD_PER_ARCMIN


def arcsec_to_rad(angle_arcsec: T) -> T:
    """Seconds of arc as radians (slope errors of mirror surfaces)."""
    return angle_arcsec * (_RAD_PER_ARCMIN / 60.0)


def rad2_to_arcmin2(area_rad2: T) -> T:
    """Square radians as square minutes of arc (areas of point spread functions)."""
    return area_rad2 / _RAD_PER_ARCMIN**2


def rad2_to_deg2(area_rad2: T) -> T:
    """Square radians as square degrees (covariances in machine-readable files)."""
    return area_rad2 / _RAD_PER_DEG**2


def deg2_to_rad2(area_deg2: T) -> T:
    """Square degrees as square radians (covariances in machine-readable files)."""
    return area_deg2 * _RAD_PER_DEG**2


def arcmin2_to_rad2(area_arcmin2: T) -> T:
    """Square minutes of arc as square radians (areas of point spread functions)."""
    return area_arcmin2 * _RAD_PER_ARCMIN**2


def cm_to_m(length_cm: T) -> T:
    """Centimetres (facet lists of the simulations) as metres."""
    return length_cm / 100.0


def m_to_cm(length_m: T) -> T:
    """Metres as centimetres (facet lists of the simulations)."""
    return length_m * 100.0


def m2_to_cm2(area_m2: T) -> T:
    """Square metres as square centimetres (areas of facets)."""
    return area_m2 * 10000.0


def mm_to_m(length_mm: T) -> T:
    """Millimetres as metres."""
    return length_mm / 1000.0


def m_to_mm(length_m: T) -> T:
    """Metres as millimetres (what a person reads of legs and bolts)."""
    return length_m * 1000.0


def m_to_um(length_m: T) -> T:
    """Metres as micrometres (how far a leg stands from its target)."""
    return length_m * 1.0e6


def um_to_m(length_um: T) -> T:
    """Micrometres (backlash in configs) as metres."""
    return length_um / 1.0e6


def ms_to_s(time_ms: T) -> T:
    """Milliseconds as seconds."""
    return time_ms / 1000.0


def s_to_ms(time_s: T) -> T:
    """Seconds as milliseconds (exposures and timeouts of camera libraries)."""
    return time_s * 1000.0


def us_to_s(time_us: T) -> T:
    """Microseconds (exposures of cameras) as seconds."""
    return time_us / 1.0e6


def s_to_us(time_s: T) -> T:
    """Seconds as microseconds (exposures of cameras)."""
    return time_s * 1.0e6


def celsius_to_k(temperature_celsius: T) -> T:
    """Degrees Celsius (drives' thermometers) as kelvins."""
    return temperature_celsius + 273.15


def k_to_celsius(temperature_k: T) -> T:
    """Kelvin as degrees Celsius (drives' own thermometers)."""
    return temperature_k - 273.15
