"""Scenes of star fields without images: places of stars from the twin's own sky and lens, with errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.geometry.star_match import known_stars
from namod_ctl.calibration.geometry.star_search import SeenStars
from namod_ctl.calibration.sky.observed_sky import Site, julian_year, observed_directions
from namod_ctl.calibration.sky.star_catalogue import bright_stars
from namod_ctl.core.units import deg_to_rad, mdeg_to_rad
from namod_ctl.twin.star_field import FieldCatalogue, Lens, Watch, faint_stars, image_of_directions, seen_from_site

INSTRUMENT = build_instrument(load_config("fact"))
CAMERA, STAR_SIZE_RAD = INSTRUMENT.star_camera, INSTRUMENT.star_size_rad
SITE = Site(deg_to_rad(28.76), deg_to_rad(-17.89), 2200.0)
CATALOGUE = bright_stars()
FAINT = faint_stars(1)
SIZE_PX = np.array([CAMERA.n_columns, CAMERA.n_rows])
EDGE_PX = 22.0


@dataclass(frozen=True)
class Scene:
    """Where the twin's telescope looks, and through which lens."""

    watch: Watch
    lens: Lens

    @property
    def direction(self):
        """Of the telescope's axis: unit vector (north, west, up)."""
        azimuth, elevation = self.watch.azimuth_rad, self.watch.elevation_rad
        return np.array([np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])

    def catalogue(self):
        """The bright stars at the scene's time, as the twin wants them."""
        moved = CATALOGUE.directions(julian_year(self.watch.moment))
        return FieldCatalogue(np.arctan2(moved[:, 1], moved[:, 0]), np.arcsin(moved[:, 2]), CATALOGUE.v_mag)

    def pixels(self, catalogue):
        """Where stars appear (n, 2); NaN behind the camera."""
        return image_of_directions(seen_from_site(catalogue, self.watch), self.watch, self.lens)

    def n_bright(self):
        """How many stars of the catalogue are in the image."""
        return int(inside(self.pixels(self.catalogue())).sum())


def inside(pixel):
    return ((pixel > EDGE_PX) & (pixel < SIZE_PX - EDGE_PX)).all(axis=1)


def scene(rng, *, is_mirrored=None):
    """Any time of a year, any place of the sky from 25 to 75 degrees altitude, any camera."""
    moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=float(rng.uniform(0.0, 365.0)))
    elevation = np.arcsin(rng.uniform(np.sin(deg_to_rad(25.0)), np.sin(deg_to_rad(75.0))))
    watch = Watch(
        moment,
        SITE.latitude_rad,
        SITE.longitude_rad,
        SITE.altitude_m,
        float(rng.uniform(0.0, 2.0 * np.pi)),
        float(elevation),
    )
    centre = (SIZE_PX - 1.0) / 2.0 + rng.normal(0.0, 20.0, 2)
    lens = Lens(
        plate_scale_rad=mdeg_to_rad(2.437) * float(rng.normal(1.0, 0.02)),
        rotation_rad=float(rng.uniform(-np.pi, np.pi)),
        is_mirrored=bool(rng.random() < 0.5) if is_mirrored is None else is_mirrored,
        centre_pixel=(float(centre[0]), float(centre[1])),
        axis_pixel=(float(CAMERA.axis_pixel[0]), float(CAMERA.axis_pixel[1])),
        brown_k1=float(rng.normal(0.0, 2.0)),
        brown_k2=float(rng.normal(0.0, 30.0)),
    )
    return Scene(watch, lens)


def rich_scene(rng, n_bright, **options):
    """One with at least so many stars of the catalogue in the image."""
    while True:
        found = scene(rng, **options)
        if found.n_bright() >= n_bright:
            return found


def seen_stars(rng, scene, *, error_px=0.05, n_false=3, faintest_mag=8.0, catalogues=None):
    """What a finder would see of a scene: catalogue stars, fainter ones, false stars; magnitudes to 0.15."""
    pixels, magnitudes = [], []
    for catalogue in catalogues or (scene.catalogue(), FAINT):
        pixel = scene.pixels(catalogue)
        chosen = inside(pixel) & (catalogue.magnitude < faintest_mag)
        pixels.append(pixel[chosen])
        magnitudes.append(catalogue.magnitude[chosen])
    pixels.append(rng.uniform(EDGE_PX, SIZE_PX - EDGE_PX, (n_false, 2)))
    magnitudes.append(rng.uniform(3.0, 6.5, n_false))
    return _seen(rng, np.concatenate(pixels), np.concatenate(magnitudes), error_px)


def random_points(rng, n):
    """Points that are no stars at all."""
    return _seen(rng, rng.uniform(EDGE_PX, SIZE_PX - EDGE_PX, (n, 2)), rng.uniform(3.0, 8.0, n), 0.05)


def foreign_sky(rng):
    """A sky of as many stars as ours, elsewhere."""
    n = len(CATALOGUE.v_mag)
    return FieldCatalogue(
        rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-1.0, 1.0, n)), rng.permutation(CATALOGUE.v_mag)
    )


def known_somewhere(rng, radius_deg, far_from=None):
    """The catalogue's stars within an angle of some place of the sky, far from the field of `far_from`."""
    directions = CATALOGUE.directions(2026.5)
    near = directions[rng.integers(len(directions))]
    if far_from is not None:
        at = observed_directions(CATALOGUE, far_from.watch.moment, SITE)
        field = directions[np.nanargmax(at @ far_from.direction)]
        near = -near if near @ field > 0.0 else near
    is_near = directions @ near >= np.cos(deg_to_rad(radius_deg))
    some = np.where(is_near[:, None], directions, np.nan)
    return known_stars(some, CATALOGUE.v_mag, CATALOGUE.is_disturbed, STAR_SIZE_RAD)


def _seen(rng, pixel, magnitude, error_px):
    pixel = pixel + rng.normal(0.0, error_px, pixel.shape)
    magnitude = magnitude + rng.normal(0.0, 0.15, magnitude.shape)
    order = np.argsort(magnitude)
    return SeenStars(pixel[order], np.full(order.size, error_px), magnitude[order], np.ones(order.size, dtype=bool))


def mirrored(stars):
    """The same frame, left and right exchanged."""
    return replace(stars, pixel=(SIZE_PX - 1.0) * [1.0, 0.0] + stars.pixel * [-1.0, 1.0])
