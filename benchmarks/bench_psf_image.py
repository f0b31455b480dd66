"""The PSF camera: is A_sigma found within 2 %, with honest uncertainties, on images of known A_sigma?

Run: python benchmarks/bench_psf_image.py [--seeds 20] [--peers] [--only aligned]

Every seed is another telescope (figure errors, misalignment, roughness), another place of the star and another noise.
The truth is the twin's, ray traced, or for gaussians on paper. "dev" is the relative error of A_sigma from one image;
"r80" that of the radius with 80 % of the light against the rays; pulls are errors over stated uncertainties.
With --peers the same images go through photutils: its background and data_properties (all moments of what is above
1.5 sigma), and a box as large as the image.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.psf_camera import TWIN_PSF_CAMERA
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.config.parts import psf_camera_of
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import arcmin_to_rad, rad2_to_arcmin2
from namod_ctl.imaging.psf_image import measure_psf
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.raytrace import tilted_normals
from namod_ctl.twin.focal_screen import PSF_CAMERA, Screen, focal_camera
from namod_ctl.twin.settings import ReflectorSettings, TelescopeSettings, TwinSettings
from namod_ctl.twin.twin import Twin

Image = NDArray[np.unsignedinteger[Any]]

DEEP = psf_camera_of(TWIN_PSF_CAMERA)
FLAT = replace(DEEP, full_scale_adu=255.0)
USUAL = Screen()
SEEDS_PER_CASE = 1000


@dataclass(frozen=True, slots=True)
class Case:
    """What is looked at: misalignment (None: a gaussian), exposure, camera, screen."""

    name: str
    misalignment_arcmin: float | None
    exposure_s: float
    camera: CameraModel = FLAT
    screen: Screen = USUAL


BRIGHT_SKY = replace(PSF_CAMERA, background_share=0.05)
CASES = (
    Case("aligned, 8 bit", 0.0, 0.05),
    Case("aligned, 12 bit", 0.0, 0.05, DEEP),
    Case("aligned, a third as bright", 0.0, 0.017),
    Case("aligned, a tenth as bright", 0.0, 0.005),
    Case("1 arcmin off", 1.0, 0.08),
    Case("4 arcmin off", 4.0, 0.25),
    Case("4 arcmin off, a third as bright", 4.0, 0.08),
    Case("bright sky, gradient, vignetting", 0.0, 0.05, FLAT, Screen(BRIGHT_SKY, 1.0, 1.0, 0.3)),
    Case("ghost with 5 % of the light", 0.0, 0.05, FLAT, Screen(ghost_share=0.05)),
    Case("elliptic gaussian", None, 0.05),
    Case("elliptic gaussian, a tenth as bright", None, 0.005),
)


def twin_frame(case: Case, seed: int) -> tuple[Image, float, float]:
    """A frame, its true A_sigma (rad2) and r80 (rad)."""
    rng = np.random.default_rng([seed, 5])
    centre = tuple(float(value) for value in rng.uniform(-1.0, 1.0, 2) * arcmin_to_rad(3.0))
    settings = TwinSettings(
        reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(case.misalignment_arcmin or 0.0)),
        telescope=TelescopeSettings(radius_rad=arcmin_to_rad(0.5), centre_rad=centre),
    )
    twin = build_twin(load_config("fact"), settings, seed)
    if case.misalignment_arcmin == 0.0:
        twin.apply_correction(twin.reflector.correction_at_rad(twin.sky.zenith_distance_rad(0.0)))
    camera = focal_camera(twin, case.camera, seed, case.screen)
    camera.start(case.exposure_s)
    image = camera.fetch(5.0).image
    return image, twin.reflector.a_sigma_now_rad2(), _r80_rad(twin, rng)


def _r80_rad(twin: Twin, rng: np.random.Generator) -> float:
    """Radius about the centroid with 80 % of the light of a star on the axis."""
    reflector = twin.reflector
    normals = tilted_normals(twin.instrument.reflector, reflector.true_tilt_rad)
    hits, light = [], []
    for surface, normal, blur_m, weight in zip(
        reflector.surfaces, normals, reflector.blur_m, reflector.light_m2, strict=True
    ):
        hit = surface.hits(surface.samples_m, normal, np.zeros(2))
        hits.append(np.repeat(hit, 4, axis=0) + blur_m * rng.standard_normal((4 * len(hit), 2)))
        light.append(np.full(4 * len(hit), weight * normal[2] / len(hit)))
    places, weights = np.concatenate(hits), np.concatenate(light)
    places = places - np.average(places, axis=0, weights=weights)
    distance = np.linalg.norm(places, axis=1)
    order = np.argsort(distance)
    grown = np.cumsum(weights[order])
    return float(distance[order][np.searchsorted(grown, 0.8 * grown[-1])]) / reflector.focal_length_m


def gaussian_frame(case: Case, seed: int) -> tuple[Image, float, float]:
    """The same for a gaussian on the same camera; r80 is drawn, too."""
    rng = np.random.default_rng([seed, 6])
    camera = case.camera
    long_px, turn = 24.0, rng.uniform(0.0, math.pi)
    short_px = long_px * rng.uniform(0.4, 1.0)
    x0, y0 = np.array([camera.n_columns, camera.n_rows]) / 2.0 + rng.uniform(-60.0, 60.0, 2)
    y, x = np.mgrid[: camera.n_rows, : camera.n_columns].astype(float)
    along = (x - x0) * np.cos(turn) + (y - y0) * np.sin(turn)
    across = (y - y0) * np.cos(turn) - (x - x0) * np.sin(turn)
    sensor = case.screen.camera
    peak = 150.0 * case.exposure_s / 0.05
    mean = peak * np.exp(-0.5 * (along**2 / long_px**2 + across**2 / short_px**2)) + 0.01 * peak * (1.0 + x / 1280.0)
    noise = np.sqrt(sensor.read_noise_adu**2 + mean / sensor.electrons_per_adu) * rng.standard_normal(mean.shape)
    image = np.clip(np.rint(mean + noise + sensor.black_level_adu), 0, camera.full_scale_adu).astype(np.uint8)
    drawn = rng.standard_normal((400_000, 2)) * (long_px, short_px)
    scale = camera.plate_scale_rad
    return image, math.pi * long_px * short_px * scale**2, float(np.quantile(np.hypot(*drawn.T), 0.8)) * scale


def photutils_area_px2(image: Image) -> float:
    """A_sigma as photutils has it: sigma-clipped background, moments of the pixels above 1.5 sigma in the segment."""
    from astropy.stats import sigma_clipped_stats
    from photutils.morphology import data_properties
    from photutils.segmentation import detect_sources

    data = image.astype(float)
    _, level, spread = sigma_clipped_stats(data, sigma=3.0)
    data -= level
    segments = detect_sources(data, 1.5 * spread, n_pixels=50)
    labels = segments.labels
    fluxes = [data[segments.data == label].sum() for label in labels]
    properties = data_properties(data, mask=segments.data != labels[int(np.argmax(fluxes))])
    return float(np.pi * np.sqrt(np.linalg.det(properties.covariance.value)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", default="", help="Cases whose name holds this.")
    parser.add_argument("--peers", action="store_true")
    arguments = parser.parse_args()
    heads = ("A", "dev %", "rms %", "worst %", "stated %", "pull", "width", "r80 %", "ms", "refused")
    peer = " photutils dev %" if arguments.peers else ""
    print(f"{'case':38s}" + "".join(f"{head:>9s}" for head in heads) + peer)
    for number, case in enumerate(CASES, start=1):
        if arguments.only in case.name:
            # a twin's noise depends on its seed and time alone: other cases get other seeds
            seeds = range(SEEDS_PER_CASE * number, SEEDS_PER_CASE * number + arguments.seeds)
            print(row(case, seeds, with_peers=arguments.peers), flush=True)


def row(case: Case, seeds: range, *, with_peers: bool) -> str:
    """Of the table."""
    make: Callable[[Case, int], tuple[Image, float, float]]
    make = gaussian_frame if case.misalignment_arcmin is None else twin_frame
    scale2 = case.camera.plate_scale_rad**2
    rows, refused, seconds = [], 0, 0.0
    for seed in seeds:
        image, area_rad2, r80_rad = make(case, seed)
        begun = time.process_time()
        try:
            found = measure_psf(image, case.camera, case.exposure_s)
        except DataQualityError as error:
            refused += 1
            print(f"  seed {seed}: {error}")
            continue
        seconds += time.process_time() - begun
        peer = photutils_area_px2(image) * scale2 / area_rad2 - 1.0 if with_peers else 0.0
        rows.append(
            (
                found.a_sigma_px2 * scale2 / area_rad2 - 1.0,
                found.uncertainty_px2 * scale2 / area_rad2,
                found.numbers[7] * case.camera.plate_scale_rad / r80_rad - 1.0,
                rad2_to_arcmin2(area_rad2),
                peer,
            )
        )
    if not rows:
        return f"{case.name:38s} all refused"
    dev, doubt, r80, area, peer_dev = np.array(rows).T
    pull = dev / doubt
    percents = [100.0 * value for value in (dev.mean(), np.sqrt(np.mean(dev**2)), np.abs(dev).max(), doubt.mean())]
    numbers = [area.mean(), *percents, pull.mean(), pull.std(), 100.0 * np.sqrt(np.mean(r80**2))]
    text = f"{case.name:38s}" + "".join(f"{number:9.2f}" for number in numbers)
    text += f"{1000.0 * seconds / len(rows):9.0f}{refused:9d}"
    return text + (f" {100.0 * peer_dev.mean():+8.1f} ± {100.0 * peer_dev.std():.1f}" if with_peers else "")


if __name__ == "__main__":
    main()
