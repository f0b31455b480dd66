"""The digital twin of a telescope with its cameras under a sky: one seed, one clock, and `update(time_s)`."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.instrument import Instrument
from namod_ctl.twin.camera import TwinCamera
from namod_ctl.twin.clock import ManualClock, WallClock
from namod_ctl.twin.drive_wiring import BusWiring
from namod_ctl.twin.drives import Journal, TwinDrives, keep_no_journal
from namod_ctl.twin.faults import Fault, FaultPlan
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.reflector_frame import ReflectorFrames
from namod_ctl.twin.sensor import Image, Sensor
from namod_ctl.twin.settings import FACT_APERTURE_RAD, CameraSettings, FaultSpec, TwinSettings
from namod_ctl.twin.sky import Sky
from namod_ctl.twin.star_frame import StarFrames
from namod_ctl.twin.surface_map import map_facets
from namod_ctl.twin.telescope import Telescope

Array = NDArray[np.float64]

STAR_LENS_M = 0.037
"""Opening of a f/1.4 lens of the star camera's plate scale, 2.437 mdeg per 2.2 um pixel: f = 52 mm."""
MAX_STEPS = 1200
"""Per light and exposure: a satellite drawn through the whole star camera in half star widths."""
MAX_REFLECTOR_STEPS = 64


class Twin:
    """Stands where the hardware stands.

    Attributes
    ----------
    clock
        Monotonic seconds; they pass when somebody waits, on this clock or for a camera.
    wall_clock
        Time of day, which faults set back.
    star_camera, reflector_camera
        Start both before fetching from either: they share the clock.
    reflector
        The true reflector, with the truth about it.
    drives
        The drives of the legs, where there are any: `wiring` says how they are wired.
    """

    def __init__(
        self, instrument: Instrument, settings: TwinSettings, seed: int, wiring: Sequence[BusWiring] = ()
    ) -> None:
        self.instrument = instrument
        self.settings = settings
        self._faults = FaultPlan()
        for spec in settings.faults:
            self._faults.inject(spec)
        self.clock = ManualClock()
        self.wall_clock = WallClock(self.clock, self._faults.wall_clock_error_s)
        self._lock = threading.Lock()
        self._journal: Journal = keep_no_journal
        self._noted = (0.0, 0, 0)
        self.drives = TwinDrives(wiring, self.clock, self._faults, seed)
        telescope = Telescope(settings.telescope, self._faults, seed)
        self.telescope = telescope
        self.sky = Sky(settings.sky, settings.telescope, telescope, self._faults, seed)
        pixels = map_facets(instrument.reflector, instrument.reflector_camera, instrument.facet_polygons_px)
        self.reflector = TwinReflector(
            instrument.reflector,
            instrument.mounts,
            [p.outline_m for p in pixels],
            settings.reflector,
            seed,
            settings.telescope.came_from_zenith_rad,
        )
        self.aperture_radius_m = (
            FACT_APERTURE_RAD * instrument.reflector.focal_length_m
            if settings.aperture_radius_m is None
            else settings.aperture_radius_m
        )
        star_sensor = Sensor(instrument.star_camera, settings.star_camera, "star", seed)
        reflector_sensor = Sensor(instrument.reflector_camera, settings.reflector_camera, "reflector", seed)
        self._star_frames = StarFrames(star_sensor, instrument.star_size_rad, seed)
        self._reflector_frames = ReflectorFrames(
            reflector_sensor,
            self.reflector,
            pixels,
            self.aperture_radius_m,
            seed,
        )
        self._exposed_tilt_rad = self.reflector.base_tilt_rad
        self.star_camera = TwinCamera(
            "star", star_sensor, self.clock, self.update, self._render_star, self._faults, seed
        )
        self.reflector_camera = TwinCamera(
            "reflector",
            reflector_sensor,
            self.clock,
            self.update,
            self._render_reflector,
            self._faults,
            seed,
            self._expose,
        )
        self.update(0.0)

    def update(self, time_s: float) -> None:
        """Let time pass until `time_s`; what has a memory (sag) follows. Nothing if that is over."""
        with self._lock:
            self.clock.advance_to_s(time_s)
            self._follow()

    def inject(
        self, name: str, *, start_s: float | None = None, duration_s: float | None = None, **params: float | str
    ) -> Fault:
        """Inject a fault of `faults.CATALOGUE`: from now on, or from `start_s`; for ever, or for `duration_s`.

        Raises ConfigError for a fault, a parameter or a value that does not exist.
        """
        start = self.clock.monotonic_s() if start_s is None else start_s
        return self.drives.inject(FaultSpec(name, start, duration_s, params))

    def apply_correction(self, tilt_correction_rad: Array) -> None:
        """Turn the facets' normals by Phi, shape (n_facets, 2), in the order of `true_theta_rad`; NaN turns none."""
        with self._lock:
            self.reflector.apply_correction(tilt_correction_rad)
            tilts = [[float(t) if np.isfinite(t) else None for t in facet] for facet in tilt_correction_rad]
            self._journal(self.clock.monotonic_s(), {"tilt_rad": tilts})

    def move_legs(self, facet_id: int, travel_m: Array) -> None:
        """Move the legs of one facet's mount, shape (n_legs,), along +z. Raises KeyError for an unknown facet."""
        with self._lock:
            self.reflector.move_legs(facet_id, travel_m)
            travels = [float(travel) for travel in travel_m]
            self._journal(self.clock.monotonic_s(), {"facet": facet_id, "travel_m": travels})

    def keep_journal(self, journal: Journal) -> None:
        """Tell `journal` from now on everything that comes in from outside; see `world`."""
        self._journal = self.drives.journal = journal

    @property
    def true_theta_rad(self) -> Array:
        """Star direction whose light's centroid hits the focal point, shape (n_facets, 2), at present."""
        self.update(self.clock.monotonic_s())
        return self.reflector.true_theta_rad

    @property
    def true_tilt_rad(self) -> Array:
        """Tilt of every facet, shape (n_facets, 2), at present."""
        self.update(self.clock.monotonic_s())
        return self.reflector.true_tilt_rad

    def true_star_theta_rad(self, time_s: float) -> Array:
        """Where the reference star stands in the telescope frame, shape (2,)."""
        theta: Array = self.telescope.star_theta(np.array([time_s]))[0]
        return theta

    def _render_star(self, start_s: float, exposure_s: float, rng: np.random.Generator) -> Image:
        tracks = self.sky.tracks(start_s, start_s + exposure_s, self._star_frames.step_rad, MAX_STEPS)
        factor = self.sky.scintillation(start_s, exposure_s, STAR_LENS_M, rng) * self._dew("star", start_s)
        background = self._background("star", start_s + exposure_s / 2.0, self.settings.star_camera)
        return self._star_frames.render(tracks, factor, background, exposure_s, rng)

    def _render_reflector(self, start_s: float, exposure_s: float, rng: np.random.Generator) -> Image:
        tracks = self.sky.tracks(start_s, start_s + exposure_s, self._reflector_frames.step_rad, MAX_REFLECTOR_STEPS)
        facet_m = math.sqrt(self.reflector.surfaces[0].area_m2)
        factor = self.sky.scintillation(start_s, exposure_s, facet_m, rng) * self._dew("reflector", start_s)
        background = self._background("reflector", start_s + exposure_s / 2.0, self.settings.reflector_camera)
        truth = self.reflector.truth_at(self._exposed_tilt_rad)
        moved_rad = self.reflector.theta_moved_rad(truth, start_s)
        return self._reflector_frames.render(tracks, truth, moved_rad, factor, background, exposure_s, rng)

    def _follow(self) -> None:
        """Let sag, drives and facets follow the clock."""
        now_s = self.clock.monotonic_s()
        self.reflector.update(now_s, self.sky.zenith_distance_rad)
        self.drives.update(now_s)
        for facet_id in sorted(self.drives.take_moved()):
            self.reflector.drive_legs(facet_id, self.drives.facet_travel_m(facet_id))
        moment = (now_s, self.star_camera.n_frames, self.reflector_camera.n_frames)
        if moment != self._noted:
            self._noted = moment
            self._journal(now_s, {"frames": moment[1:]})

    def _expose(self) -> None:
        """The reflector camera begins: facets that are under way are seen where they are now.

        Were they seen where they are when the frame is fetched, frames would depend on which camera is fetched first.
        """
        with self._lock:
            self._follow()
            self._exposed_tilt_rad = self.reflector.base_tilt_rad

    def _background(self, role: str, time_s: float, settings: CameraSettings) -> tuple[float, Array]:
        level, slope = self.sky.background(time_s)
        dimmed = self._dew(role, time_s)
        return dimmed * (settings.background_share + level), dimmed * slope

    def _dew(self, role: str, time_s: float) -> float:
        """Share of light that a dewed lens lets through."""
        share = 1.0
        for fault in self._faults.active("dew", time_s, role):
            floor = fault.value("floor")
            share *= floor + (1.0 - floor) * math.exp(-(time_s - fault.start_s) / fault.value("decay_s"))
        return share
