"""The estimators of a facet's centre against each other, on made runs of known truth and on FACT's own halves.

Run: python benchmarks/bench_estimators.py [folder of FACT response maps]

The rival `gaussian (scipy)` is the ordinary answer: an elliptical gaussian with background per facet, scipy's
least_squares with soft_l1 loss, started at the brightest record. Runs are made by the generator of the tests, which
throws rays and shares no code with the estimators. Seeds are not those of the tests.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.reconstruction.estimators import SIMPLE_ESTIMATORS
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import ResponseTable
from namod_ctl.store.response_maps import read_response_maps

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "reconstruction"))
from response_maker import disc, instrument, make_run, wandering_path

ARCMIN = arcmin_to_rad(1.0)
BIN_SIZE_RAD = deg_to_rad(0.01)
WRONG_STAR_SHARE = 0.03
SEEDS = range(9001, 9006)


def robust(table: ResponseTable) -> np.ndarray:
    alignment = reconstruct(table, instrument(len(table.facet_ids))).alignment
    return np.array([facet.theta_rad for facet in alignment.facets])


def gaussian(table: ResponseTable) -> np.ndarray:
    """Centres by scipy, facet by facet; widths start at 0.02 deg."""
    centres = []
    for response in table.response.T:
        k = int(np.argmax(response))
        near = np.linalg.norm(table.theta_rad - table.theta_rad[k], axis=1) < deg_to_rad(0.12)
        theta, measured = table.theta_rad[near], response[near] / response[k]

        def residual(p: np.ndarray, theta: np.ndarray = theta, measured: np.ndarray = measured) -> np.ndarray:
            u = ((theta - p[1:3]) / deg_to_rad(0.02)) @ np.array([[np.exp(p[3]), p[5]], [0.0, np.exp(p[4])]])
            return (np.exp(p[0] - 0.5 * (u**2).sum(axis=1)) + p[6] - measured) / 0.05

        start = np.array([0.0, *table.theta_rad[k], 0.0, 0.0, 0.0, 0.0])
        centres.append(least_squares(residual, start, loss="soft_l1", x_scale=[1, 1e-4, 1e-4, 1, 1, 1, 1]).x[1:3])
    return np.array(centres)


ESTIMATORS: dict[str, Callable[[ResponseTable], np.ndarray]] = {
    "brightest": lambda table: SIMPLE_ESTIMATORS["brightest"](table, BIN_SIZE_RAD).theta_rad,
    "cog": lambda table: SIMPLE_ESTIMATORS["cog"](table, BIN_SIZE_RAD).theta_rad,
    "histogram-cog": lambda table: SIMPLE_ESTIMATORS["histogram-cog"](table, BIN_SIZE_RAD).theta_rad,
    "gaussian (scipy)": gaussian,
    "robust": robust,
}


def with_wrong_stars(table: ResponseTable, seed: int) -> ResponseTable:
    rng = np.random.default_rng([seed, 1])  # not the stream that made the run
    theta = table.theta_rad.copy()
    wrong = rng.random(len(theta)) < WRONG_STAR_SHARE
    theta[wrong] = disc(rng, int(wrong.sum()))
    return ResponseTable(
        table.facet_ids, table.record_index, theta, table.theta_uncertainty_rad, table.response, table.faintness
    )


def made_runs() -> None:
    cases = {
        "1350 even": lambda seed: make_run(seed),
        "300 even": lambda seed: make_run(seed, n_records=300),
        "1350 spiral": lambda seed: make_run(seed, path=wandering_path),
    }
    print("Error of the centre per axis against truth, rms over 30 facets and 5 runs / arcmin")
    print(f"{'':18s}" + "".join(f"{name:>14s}" for name in [*cases, "1350, 3% wrong"]))
    made = {name: [make(seed) for seed in SEEDS] for name, make in cases.items()}
    tables = {name: [(run.table, run.centre_rad) for run in runs] for name, runs in made.items()}
    tables["1350, 3% wrong"] = [
        (with_wrong_stars(run.table, seed), run.centre_rad) for run, seed in zip(made["1350 even"], SEEDS, strict=True)
    ]
    for name, estimate in ESTIMATORS.items():
        row = []
        for runs in tables.values():
            errors = np.concatenate([estimate(table) - truth for table, truth in runs])
            row.append(np.sqrt(np.nanmean(errors**2)) / ARCMIN)
        print(f"{name:18s}" + "".join(f"{value:14.3f}" for value in row), flush=True)


def fact_halves(folder: Path) -> None:
    maps = read_response_maps(folder, build_instrument(load_config("fact")).reflector.ids)
    print("\nFACT 2014, even against odd records: distance of the two centres of a facet / arcmin")
    print(f"{'':18s}{'median':>10s}{'rms':>10s}")
    n = len(maps.theta_rad)
    table = ResponseTable(
        tuple(range(1, maps.response.shape[1] + 1)),
        np.arange(n),
        maps.theta_rad,
        np.full(n, np.nan),
        maps.response,
        np.ones(n),
    )
    for name, estimate in ESTIMATORS.items():
        even, odd = (estimate(table.select(np.arange(first, n, 2))) for first in (0, 1))
        distance = np.linalg.norm(even - odd, axis=1) / ARCMIN
        print(f"{name:18s}{np.nanmedian(distance):10.2f}{np.sqrt(np.nanmean(distance**2)):10.2f}")


def main() -> None:
    made_runs()
    if len(sys.argv) > 1:
        fact_halves(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
