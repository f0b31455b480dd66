"""The true reflector: its facets as they are, how they sag and drift, and the truth about them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.raytrace import LightMoments, a_sigma_rad2, combine_moments, tilted_normals
from namod_ctl.optics.reflector import Reflector
from namod_ctl.twin.facet_surface import N_FIGURE_ERRORS, FacetSurface, seen_samples
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import ReflectorSettings

Array = NDArray[np.float64]

TILT_STEP_RAD = 1e-5
TICK_S = 1.0
"""The sky turns 15 arcsec in it: no sag changes noticeably."""
SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class FacetTruth:
    """What does not change with time, unless somebody turns bolts or motors turn.

    Attributes
    ----------
    base_tilt_rad
        Shape (n_facets, 2). The tilts it is the truth of; sag and drift are not in it.
    normals
        Shape (n_facets, 3).
    theta_rad
        Shape (n_facets, 2). Star direction whose light has its centroid on the focal point.
    theta_per_tilt
        Shape (n_facets, 2, 2). How that moves with the facet's tilt; 2 but for obliquity.
    """

    base_tilt_rad: Array
    normals: Array
    theta_rad: Array
    theta_per_tilt: Array


class TwinReflector:
    """All facets; sag and drift are small and move each facet's image as a whole.

    Call `update` before asking for anything that changes with time. `seen_outlines_m` holds for every facet, in its own
    x and y, what of it can be seen from the focal point.
    """

    def __init__(
        self,
        reflector: Reflector,
        mounts: Mapping[int, Mount],
        seen_outlines_m: Sequence[Array],
        settings: ReflectorSettings,
        seed: int,
        came_from_zenith_rad: float = 0.0,
    ) -> None:
        n = len(reflector.facets)
        self._config = reflector
        self._mounts = mounts
        self._settings = settings

        def draw(purpose: str, *shape: int) -> Array:
            return generator(seed, purpose).standard_normal((n, *shape))

        focal_shares = 1.0 + settings.focal_length_spread * draw("focal length")
        figures = settings.figure_blur_rad / 2.0 * draw("figure", N_FIGURE_ERRORS)
        self.surfaces = tuple(
            FacetSurface(
                replace(facet, focal_length_m=facet.focal_length_m * share),
                figure,
                seen_samples(facet, outline_m),
                reflector.focal_length_m,
            )
            for facet, share, figure, outline_m in zip(
                reflector.facets, focal_shares, figures, seen_outlines_m, strict=True
            )
        )
        self.roughness_rad = settings.roughness_rad * np.exp(settings.roughness_spread * draw("roughness"))
        self.reflectivity = np.clip(
            settings.reflectivity + settings.reflectivity_spread * draw("reflectivity"), 0.05, 1.0
        )
        self._base_tilt_rad = settings.misalignment_rad / 2.0 * draw("tilt", 2)
        # Facets sink towards -y, the lower rim of a dish that leans over its elevation axis; none rises.
        sag = np.column_stack([0.2 * draw("sag sideways"), -np.exp(0.4 * draw("sag"))])
        self._sag_rad = settings.sag_rad * sag
        across_m = reflector.positions_m[:, :2]
        rim_m = float(np.linalg.norm(across_m, axis=1).max()) or 1.0  # a single facet may lie on the axis
        self._bending_rad = settings.bending_rad * (across_m / rim_m + 0.2 * draw("bending", 2))
        self._came_from_zenith_rad = came_from_zenith_rad
        self._drift_rad_per_kelvin = settings.drift_rad_per_kelvin * draw("drift", 2)
        self._driven_tilt_rad = np.zeros((n, 2))  # by motors, since the twin began
        self._sag_zenith_rad: list[float] = []  # the zenith distance that the sag has followed to, tick by tick
        self._truth = FacetTruth(np.full((n, 2), np.nan), np.empty((n, 3)), np.empty((n, 2)), np.empty((n, 2, 2)))

    @property
    def ids(self) -> tuple[int, ...]:
        """Facet ids in the order of all arrays."""
        return self._config.ids

    @property
    def focal_length_m(self) -> float:
        """Of the telescope."""
        return self._config.focal_length_m

    def update(self, time_s: float, zenith_distance_rad: Callable[[float], float]) -> None:
        """Let sag and temperature follow until `time_s`; the sag lags behind the zenith distance when that turns back.

        The sag is followed tick by tick from the clock's zero, so that it depends on no order of calls.
        """
        lag = self._settings.sag_hysteresis_rad
        while len(self._sag_zenith_rad) * TICK_S <= time_s:
            zenith_rad = zenith_distance_rad(len(self._sag_zenith_rad) * TICK_S)
            before = self._sag_zenith_rad[-1] if self._sag_zenith_rad else self._came_from_zenith_rad
            self._sag_zenith_rad.append(min(max(before, zenith_rad - lag), zenith_rad + lag))

    def moved_rad(self, time_s: float) -> Array:
        """Tilt by sag and drift, shape (n_facets, 2), at a moment up to which `update` was called."""
        tick = int(time_s // TICK_S)
        kelvin = -self._settings.cooling_kelvin_per_hour * tick * TICK_S / SECONDS_PER_HOUR
        return self.sag_rad(self._sag_zenith_rad[tick]) + self._drift_rad_per_kelvin * kelvin

    def sag_rad(self, zenith_rad: float) -> Array:
        """Tilt by gravity alone, shape (n_facets, 2), of a dish whose play is taken up at that zenith distance."""
        bent = self._bending_rad * (1.0 - math.cos(zenith_rad))
        sag: Array = self._sag_rad * math.sin(zenith_rad) + bent
        return sag

    def theta_moved_rad(self, truth: FacetTruth, time_s: float) -> Array:
        """By how much sag and drift have moved the facets' true Theta at that moment, shape (n_facets, 2)."""
        moved: Array = np.einsum("fab,fb->fa", truth.theta_per_tilt, self.moved_rad(time_s))
        return moved

    @property
    def _last_s(self) -> float:
        return (len(self._sag_zenith_rad) - 1) * TICK_S

    @property
    def base_tilt_rad(self) -> Array:
        """Tilt of every facet without sag and drift, shape (n_facets, 2): as made, turned by hand and by motors."""
        tilt: Array = self._base_tilt_rad + self._driven_tilt_rad
        return tilt

    @property
    def true_tilt_rad(self) -> Array:
        """Tilt of every facet at present, shape (n_facets, 2)."""
        tilt: Array = self.base_tilt_rad + self.moved_rad(self._last_s)
        return tilt

    @property
    def true_theta_rad(self) -> Array:
        """Star direction whose light has its centroid on the focal point at present, shape (n_facets, 2)."""
        truth = self.truth
        theta: Array = truth.theta_rad + self.theta_moved_rad(truth, self._last_s)
        return theta

    def apply_correction(self, tilt_correction_rad: Array) -> None:
        """Turn every facet's normal by Phi, shape (n_facets, 2); NaN leaves a facet as it is."""
        self._base_tilt_rad = self._base_tilt_rad + np.nan_to_num(np.asarray(tilt_correction_rad, dtype=np.float64))

    def drive_legs(self, facet_id: int, travel_m: Mapping[int, float]) -> None:
        """Say how far a facet's motors have moved its legs, by their index, along +z since the twin began.

        Raises KeyError for an unknown facet or leg.
        """
        mount = self._mounts[facet_id]
        legs = range(len(mount.legs_m))
        if not set(travel_m) <= set(legs):
            raise KeyError(f"facet {facet_id} has no legs {sorted(set(travel_m) - set(legs))}")
        travel = np.array([travel_m.get(leg, 0.0) for leg in legs])
        driven = self._driven_tilt_rad.copy()
        driven[self.ids.index(facet_id)] = mount.tilt_of_travel(travel)
        self._driven_tilt_rad = driven

    def move_legs(self, facet_id: int, travel_m: Array) -> None:
        """Move the legs of one facet's mount by `travel_m` (n_legs,), along +z. Raises KeyError for an unknown id."""
        correction = np.zeros((len(self.ids), 2))
        correction[self.ids.index(facet_id)] = self._mounts[facet_id].tilt_of_travel(travel_m)
        self.apply_correction(correction)

    def a_sigma_now_rad2(self) -> float:
        """A_sigma of the star on the axis, facets as they are at present, by exact ray tracing."""
        return self._a_sigma(self.true_tilt_rad)

    def a_sigma_at_rad2(self, zenith_rad: float) -> float:
        """The same if the telescope stood at that zenith distance, without drift and play."""
        return self._a_sigma(self.base_tilt_rad + self.sag_rad(zenith_rad))

    def correction_at_rad(self, zenith_rad: float) -> Array:
        """Phi, shape (n_facets, 2), to first order, that aligns all facets at that zenith distance."""
        truth = self.truth
        theta = truth.theta_rad + np.einsum("fab,fb->fa", truth.theta_per_tilt, self.sag_rad(zenith_rad))
        correction: Array = -np.linalg.solve(truth.theta_per_tilt, theta[..., None])[..., 0]
        return correction

    def a_sigma_aligned_rad2(self) -> float:
        """A_sigma of the same facets, each with its light's centroid on the focal point: the limit of alignment."""
        tilt = self.true_tilt_rad
        for _ in range(2):
            normals = tilted_normals(self._config, tilt)
            theta = np.array([s.centred_theta(normal) for s, normal in zip(self.surfaces, normals, strict=True)])
            tilt = tilt - np.linalg.solve(self.truth.theta_per_tilt, theta[..., None])[..., 0]
        return self._a_sigma(tilt)

    def _a_sigma(self, tilt_rad: Array) -> float:
        normals = tilted_normals(self._config, tilt_rad)
        hits = [s.hits(s.samples_m, normal, np.zeros(2)) for s, normal in zip(self.surfaces, normals, strict=True)]
        mean = np.array([hit.mean(axis=0) for hit in hits])
        cov = np.array([np.cov(hit.T, bias=True) for hit in hits])
        cov = cov + (self.blur_m**2)[:, None, None] * np.eye(2)
        light = self.light_m2 * normals[:, 2]
        return a_sigma_rad2(combine_moments(LightMoments(light, mean, cov)).cov_m2, self.focal_length_m)

    @property
    def light_m2(self) -> Array:
        """Mirror area times reflectivity, shape (n_facets,)."""
        light: Array = np.array([surface.area_m2 for surface in self.surfaces]) * self.reflectivity
        return light

    @property
    def blur_m(self) -> Array:
        """Standard deviation per axis of the light in the focal plane by roughness, shape (n_facets,)."""
        to_focus = np.array([0.0, 0.0, self.focal_length_m]) - self._config.positions_m
        blur: Array = 2.0 * self.roughness_rad * np.linalg.norm(to_focus, axis=1)
        return blur

    @property
    def truth(self) -> FacetTruth:
        """The truth at the present base tilt."""
        return self.truth_at(self.base_tilt_rad)

    def truth_at(self, base_tilt_rad: Array) -> FacetTruth:
        """The truth at base tilts, shape (n_facets, 2). Facets that stand as when it was last asked cost no time."""
        known = self._truth
        is_new = np.any(base_tilt_rad != known.base_tilt_rad, axis=1)
        if not is_new.any():
            return known
        normals = tilted_normals(self._config, base_tilt_rad)
        theta, per_tilt = known.theta_rad.copy(), known.theta_per_tilt.copy()
        steps = [tilted_normals(self._config, base_tilt_rad + step) for step in TILT_STEP_RAD * np.eye(2)]
        for j in np.flatnonzero(is_new):
            surface = self.surfaces[j]
            theta[j] = surface.centred_theta(normals[j])
            samples = surface.samples_m
            by_theta = surface.hit_slopes(samples, normals[j], theta[j]).mean(axis=0)
            by_tilt = [surface.hits(samples, step[j], theta[j]).mean(axis=0) / TILT_STEP_RAD for step in steps]
            per_tilt[j] = -np.linalg.solve(by_theta, np.column_stack(by_tilt))
        self._truth = FacetTruth(base_tilt_rad, normals, theta, per_tilt)
        return self._truth
