"""How true and how honest the geometry of cameras is over seeds: a star's trail, one long exposure, chessboards.

The star camera of FACT with a plate scale, rotation, parity and distortion that its config does not know. Trails are
the twin's (spherical triangles, Saemundsson's refraction), seen in frames with noise, hot pixels, clouds, jittering
times and wind, over La Palma at 25 to 75 deg of altitude; corners of chessboards are projected with 0.1 px of noise.
The pull is the error over the stated uncertainty: its rms is 1 for an honest one.

    python benchmarks/bench_trail.py [--seeds 20]
"""
# ruff: noqa: E402 - the number of threads is set before the libraries are loaded, which read it then

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "calibration"))

from test_chessboard import BOARD
from test_chessboard import CAMERA as BOARD_CAMERA
from test_chessboard import projected as projected_board

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.geometry.chessboard import calibrate_with_boards
from namod_ctl.calibration.geometry.star_streak import fit_streak
from namod_ctl.calibration.geometry.star_trail import fit_trail
from namod_ctl.calibration.geometry.trail_frames import find_trail, trail_spots
from namod_ctl.calibration.sky.observed_sky import Site
from namod_ctl.calibration.sky.star_path import apparent_path, path_of_declination, place_of_date
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import arcsec_to_rad, deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.chessboard import draw_poses
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_trail import TrailScene, TrailTwin

SITE = Site(deg_to_rad(28.76), deg_to_rad(-17.89), 2200.0)
BEGUN = datetime(2026, 11, 22, 2, 0, tzinfo=UTC)
INSTRUMENT = build_instrument(load_config("fact"))
CAMERA = INSTRUMENT.star_camera
N_FRAMES, EXPOSURE_S, HALF_WAY_DEG = 60, 0.05, 1.95
LIMIT_MDEG, LIMIT_DEG = 0.0005, 0.01
"""What issue 7 asks for: plate scale per pixel, and rotation."""

Found = tuple[float, float, float, float]
"""Error and uncertainty of the plate scale (mdeg per pixel) and of the rotation (deg); NaN for none."""


def true_camera(rng: np.random.Generator) -> CameraModel:
    """The camera as it is."""
    middle = np.array([CAMERA.n_columns - 1, CAMERA.n_rows - 1]) / 2.0
    return replace(
        CAMERA,
        plate_scale_rad=CAMERA.plate_scale_rad * (1.0 + float(rng.normal(0.0, 0.003))),
        orientation=CameraOrientation(float(rng.uniform(-math.pi, math.pi)), bool(rng.integers(2))),
        distortion=Distortion(middle, float(rng.uniform(-0.6, 0.6))),
    )


def draw_scene(rng: np.random.Generator) -> tuple[TrailScene, tuple[float, float]]:
    """A star at a good height, and its ICRS place."""
    while True:
        place = float(rng.uniform(0.0, math.tau)), float(np.arcsin(rng.uniform(-0.6, 0.9)))
        hour_angle, declination = place_of_date(BEGUN, *place, SITE)
        scene = TrailScene(
            SITE.latitude_rad,
            declination,
            hour_angle,
            (float(rng.normal(0.0, 0.004)), float(rng.normal(0.0, 0.004))),
            SITE.altitude_m,
            time_jitter_s=0.05,
            wind_rad=arcsec_to_rad(1.0),
            cloud_share=0.1,
        )
        altitude = float(scene.horizontal_rad(np.zeros(1))[0][0])
        if deg_to_rad(25.0) < altitude < deg_to_rad(75.0):
            return scene, place


def trail_found(seed: int, has_site: bool) -> Found:
    """One trail through frames."""
    rng = np.random.default_rng(seed)
    truth, (scene, place) = true_camera(rng), draw_scene(rng)
    half_s = HALF_WAY_DEG / (15.041 / 3600.0) / math.cos(scene.declination_rad)
    twin = TrailTwin(scene, truth, INSTRUMENT.star_size_rad, STAR_CAMERA, seed)
    frames = list(twin.frames(np.linspace(-half_s, half_s, N_FRAMES), EXPOSURE_S))
    spots = [trail_spots(frame.exposure.image, CAMERA, INSTRUMENT.star_size_rad, EXPOSURE_S) for frame in frames]
    found = find_trail(np.array([frame.time_s for frame in frames]), spots)
    if has_site:
        utc = [BEGUN + timedelta(seconds=float(t)) for t in found.trail.time_s]
        path = apparent_path(utc, *place, SITE)
    else:
        path = path_of_declination(found.trail.time_s, scene.declination_rad)
    fit = fit_trail(found.trail, path, CAMERA)
    if fit.is_mirrored not in (None, truth.orientation.is_mirrored):
        raise AssertionError(f"seed {seed}: wrong parity")
    turned = math.remainder(fit.camera.orientation.rotation_rad - truth.orientation.rotation_rad, math.tau)
    is_told = has_site and fit.is_mirrored is not None
    return (
        rad_to_mdeg(fit.camera.plate_scale_rad - truth.plate_scale_rad),
        rad_to_mdeg(fit.plate_scale_uncertainty_rad),
        rad_to_deg(turned) if is_told else math.nan,
        rad_to_deg(fit.rotation_uncertainty_rad) if is_told else math.nan,
    )


def streak_found(seed: int) -> Found:
    """One exposure of 300 s."""
    rng = np.random.default_rng(seed)
    truth, (scene, _) = true_camera(rng), draw_scene(rng)
    scene = replace(scene, magnitude=1.0, cloud_share=0.0, declination_rad=min(scene.declination_rad, 1.0))
    settings = replace(STAR_CAMERA, exposure_at_mag0_s=15.0, n_hot_pixels=20)
    (frame,) = TrailTwin(scene, truth, INSTRUMENT.star_size_rad, settings, seed).frames(np.zeros(1), 300.0)
    fit = fit_streak(frame.exposure.image, CAMERA, INSTRUMENT.star_size_rad, 300.0, scene.declination_rad)
    off = rad_to_mdeg(fit.plate_scale_rad - truth.plate_scale_rad)
    return off, rad_to_mdeg(fit.plate_scale_uncertainty_rad), math.nan, math.nan


def board_found(seed: int) -> Found:
    """Twelve views of a board by a camera of 30 mdeg per pixel."""
    focal_px = float(np.random.default_rng(seed).normal(1910.0, 20.0))
    views = [
        projected_board(pose, focal_px, np.array([240.0, 180.0]), -0.1, 0.1, 1000 * seed + number)
        for number, pose in enumerate(draw_poses(BOARD, BOARD_CAMERA, 12, seed))
    ]
    fit = calibrate_with_boards(views, BOARD.corners, BOARD.square_m, BOARD_CAMERA)
    off = rad_to_mdeg(fit.camera.plate_scale_rad - 1.0 / focal_px)
    return off, rad_to_mdeg(fit.plate_scale_uncertainty_rad), math.nan, math.nan


def add_row(table: Table, name: str, one: Callable[[int], Found], n_seeds: int) -> None:
    """Run it for all seeds."""
    begun_s, found, refused = time.perf_counter(), [], 0
    for seed in range(n_seeds):
        try:
            found.append(one(seed))
        except DataQualityError as error:
            refused += 1
            print(f"{name}, seed {seed}: {error}", file=sys.stderr)
    passed_s = (time.perf_counter() - begun_s) / n_seeds
    off, doubt, turned, turn_doubt = np.array(found).T
    is_told = np.isfinite(turned)
    table.add_row(
        name,
        f"{len(found)} ({refused} refused)",
        f"{np.sqrt(np.mean(off**2)):.5f}",
        f"{np.median(doubt):.5f}",
        f"{np.sqrt(np.mean((off / doubt) ** 2)):.2f}",
        f"{np.mean(np.abs(off) < LIMIT_MDEG):.0%}",
        f"{np.sqrt(np.mean(turned[is_told] ** 2)):.4f}" if is_told.any() else "",
        f"{np.sqrt(np.mean((turned / turn_doubt)[is_told] ** 2)):.2f}" if is_told.any() else "",
        f"{np.mean(np.abs(turned[is_told]) < LIMIT_DEG):.0%}" if is_told.any() else "",
        f"{passed_s:.1f}",
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    n_seeds = parser.parse_args().seeds
    table = Table(title=f"geometry of cameras, {n_seeds} seeds each")
    for heading in (
        "from", "seeds", "scale error / (mdeg/px), rms", "stated", "pull, rms", f"within {LIMIT_MDEG}",
        "rotation error / deg, rms", "pull, rms", f"within {LIMIT_DEG}", "s per seed",
    ):  # fmt: skip
        table.add_column(heading)
    add_row(table, "trail, with site and star", lambda seed: trail_found(seed, has_site=True), n_seeds)
    add_row(table, "trail, declination only", lambda seed: trail_found(seed, has_site=False), n_seeds)
    add_row(table, "one exposure of 300 s", streak_found, n_seeds)
    add_row(table, "chessboard, 30 mdeg/px", board_found, n_seeds)
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
