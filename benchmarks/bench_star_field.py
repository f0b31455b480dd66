"""The star camera's geometry from fields of stars: how precise, how honest, and how often wrong.

Run: python benchmarks/bench_star_field.py [n_points [n_foreign [n_frames]]]

points: scenes of the twin's sky and lens at any place of the sky (25 to 75 deg altitude), stars' places with errors of
0.05 px, three false stars and all fainter ones to magnitude 8; solved with a hint of 4 deg, by number of catalogue
stars in the field. Lenses bend by 1 % at the corner (one sigma), are turned anyhow, mirrored or not.
frames: the same from images: two exposures of 1 s, noise, 60 hot pixels and three hot spots as wide as stars; solved
blind, in the whole sky. Fields of 8 catalogue stars and more, as the command asks for.
foreign: frames of a sky of as many other stars (one in four of these blind), of random points, and of the true sky with
a wrong hint; the least number of solutions as good as the best one that chance is said to make in a search. If that
number is honest, a share of about x of the searches finds one below x.

error: root mean square of found less true. pull: of error over what is stated; what is stated of the rotation holds a
second of the clock and a pixel of the axis, which are right here. goal: 0.0005 mdeg per pixel, 0.01 deg.
"""
# ruff: noqa: E402 - the number of threads is set before the libraries are loaded, which read it then

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "calibration"))

from star_field_rig import (
    CAMERA,
    CATALOGUE,
    FAINT,
    SITE,
    STAR_SIZE_RAD,
    foreign_sky,
    known_somewhere,
    random_points,
    rich_scene,
    scene,
    seen_stars,
)

from namod_ctl.calibration.geometry.field_geometry import Hint, Watch, solve_field
from namod_ctl.calibration.geometry.plate_solution import lens_priors
from namod_ctl.calibration.geometry.star_field import field_of_frames, stars_of_frame
from namod_ctl.calibration.geometry.star_match import MAX_FALSE_EXPECTED
from namod_ctl.calibration.geometry.star_search import FieldSearch
from namod_ctl.calibration.sky.observed_sky import julian_year, observed_directions
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg, rad_to_mdeg
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_field import FalseStar, StarFieldCamera

GROUPS = ((0, 3), (4, 4), (5, 5), (6, 7), (8, 11), (12, 99))


def main(n_points: int, n_foreign: int, n_frames: int) -> None:
    """Print the tables."""
    console = Console(width=130)
    console.print(_table("points, hinted", [_of_points(seed) for seed in range(n_points)]))
    console.print(_table("frames, blind", [_of_frames(seed) for seed in range(n_frames)]))
    expected = np.array([_foreign(seed) for seed in range(n_foreign)])
    table = Table(title=f"{n_foreign} foreign skies, random points, wrong hints; limit {MAX_FALSE_EXPECTED:g}")
    table.add_column("expected by chance below")
    table.add_column("share of searches", justify="right")
    for limit in (1.0, 0.1, 0.01, 1e-3, 1e-4, MAX_FALSE_EXPECTED):
        table.add_row(f"{limit:g}", f"{np.mean(expected < limit):.4f}")
    table.add_row("lowest", f"{expected.min():.2g}" if n_foreign else "")
    console.print(table)


def _of_points(seed):
    rng = np.random.default_rng([seed, 1])
    case = scene(rng)
    return _solved(case, seen_stars(rng, case), is_hinted=True)


def _of_frames(seed):
    rng = np.random.default_rng([seed, 2])
    case = rich_scene(rng, 8)
    eyes = StarFieldCamera(CAMERA, Sensor(CAMERA, STAR_CAMERA, "star camera", seed), case.lens, STAR_SIZE_RAD, seed)
    false = tuple(FalseStar(*rng.uniform(100.0, 1800.0, 2), rng.uniform(3.5, 6.0)) for _ in range(3))
    frames = [eyes.expose((case.catalogue(), FAINT), case.watch, 1.0, false) for _ in range(2)]
    try:
        found = [stars_of_frame(frame, CAMERA, STAR_SIZE_RAD) for frame in frames]
        stars = field_of_frames(found, ["one", "two"], CAMERA).stars
    except DataQualityError:
        return case.n_bright(), None, 0.0
    return _solved(case, stars, is_hinted=False)


def _solved(case, stars, *, is_hinted):
    """Number of bright stars; (error of scale, stated, error of rotation, stated), None if refused; seconds."""
    hint = None
    if is_hinted:
        at = observed_directions(CATALOGUE, case.watch.moment, SITE)
        nearest = int(np.nanargmax(at @ case.direction))
        hint = Hint(CATALOGUE.directions(julian_year(case.watch.moment))[nearest], deg_to_rad(4.0))
    begin_s = time.process_time()
    try:
        geometry = solve_field(stars, CATALOGUE, CAMERA, STAR_SIZE_RAD, Watch(case.watch.moment, SITE), hint)
    except DataQualityError:
        return case.n_bright(), None, time.process_time() - begin_s
    plate = geometry.match.fit.plate
    turn = float(np.angle(np.exp(1j * (geometry.rotation_rad - case.lens.rotation_rad))))
    if plate.is_mirrored != case.lens.is_mirrored:
        turn = np.pi  # a wrong match, which the table would show
    values = (
        rad_to_mdeg(plate.plate_scale_rad - case.lens.plate_scale_rad),
        rad_to_mdeg(geometry.plate_scale_uncertainty_rad),
        rad_to_deg(turn),
        rad_to_deg(geometry.rotation_uncertainty_rad),
    )
    return case.n_bright(), values, time.process_time() - begin_s


def _foreign(seed):
    rng = np.random.default_rng([seed, 3])
    case = scene(rng)
    known = known_somewhere(rng, 180.0 if seed % 10 == 0 else 9.0)
    if seed % 10 == 0 or seed % 3 == 0:
        stars = seen_stars(rng, case, catalogues=(foreign_sky(rng),))
    elif seed % 3 == 1:
        stars = random_points(rng, int(rng.integers(4, 60)))
    else:
        stars, known = seen_stars(rng, case), known_somewhere(rng, 9.0, far_from=case)
    if len(stars.pixel) < 4:
        return np.inf
    found = FieldSearch(stars, known, CAMERA, lens_priors(CAMERA)).solutions()
    return min((match.false_expected for match in found), default=np.inf)


def _table(title, rows):
    table = Table(title=f"{title}: {len(rows)} scenes")
    for heading in (
        "catalogue stars",
        "scenes",
        "solved",
        "scale: error",
        "worst",
        "in goal",
        "pull",
        "rotation: error",
        "worst",
        "in goal",
        "pull",
        "CPU / s",
    ):
        table.add_column(heading, justify="right")
    for low, high in GROUPS:
        chosen = [row for row in rows if low <= row[0] <= high]
        solved = np.array([row[1] for row in chosen if row[1] is not None]).reshape(-1, 4)
        cells = [f"{low} to {high}", str(len(chosen)), str(len(solved))]
        if len(solved):
            scale, scale_error, turn, turn_error = solved.T
            cells += [
                f"{_rms(scale):.5f}",
                f"{np.abs(scale).max():.5f}",
                f"{np.mean(np.abs(scale) <= 0.0005):.0%}",
                f"{_rms(scale / scale_error):.2f}",
                f"{_rms(turn):.4f}",
                f"{np.abs(turn).max():.4f}",
                f"{np.mean(np.abs(turn) <= 0.01):.0%}",
                f"{_rms(turn / turn_error):.2f}",
                f"{np.mean([row[2] for row in chosen]):.1f}",
            ]
        table.add_row(*cells)
    return table


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    numbers = [int(text) for text in sys.argv[1:]]
    main(*(numbers + [100, 300, 10][len(numbers) :]))
