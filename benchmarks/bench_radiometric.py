"""Radiometric calibration on the twin's lamp: are true laws recovered, and are the stated errors honest?

Run: python benchmarks/bench_radiometric.py [n_seeds [number of a case, from 0 ...]]

Two cameras with the paper's laws, 8 bit, exposures from 1 ms to 3 s, at ten distances that a person sets within 2 mm
and reads on a tape whose end is off by as much, and other series that are better or worse. Every seed is a whole
guided series with darks, from pixels to covariance, on images of a few thousand pixels.

honest: mean stated error over the scatter of what is found. pull: root mean square of (found - true) / stated error.
within 2: share of series whose parameter lies within two stated errors of the truth. within 1 %: share of series whose
law gives intensities within 1 % everywhere in three decades of intensity, at responses from 3 to 90 % of full scale and
exposures from 1 ms to 3 s.
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

from lamp_rig import Case, intensity_departure, series_of_twin

CASES = [
    Case(
        "reflector camera, distances within 2 mm, each and all together",
        "reflector",
        distance_error_m=0.002,
        common_distance_error_m=0.002,
    ),
    Case(
        "star camera, distances within 2 mm, each and all together",
        "star",
        distance_error_m=0.002,
        common_distance_error_m=0.002,
    ),
    Case(
        "star camera, distances within 2 mm, all together 5 mm",
        "star",
        distance_error_m=0.002,
        common_distance_error_m=0.005,
    ),
    Case("star camera, exact levels", "star", uses_levels=True),
    Case(
        "reflector camera in colour, levels within 1 %",
        "reflector",
        uses_levels=True,
        level_error_share=0.01,
        n_channels=3,
    ),
    Case(
        "star camera, black level 6, drift of 5 % per hour",
        "star",
        distance_error_m=0.002,
        common_distance_error_m=0.002,
        black_level_adu=6.0,
        drift=0.05,
    ),
    Case("star camera, curved by 0.06", "star", distance_error_m=0.002, common_distance_error_m=0.002, r_curve=0.06),
]


def main(n_seeds: int, cases: list[Case]) -> None:
    """Print the table."""
    table = Table(title=f"{n_seeds} seeds each; laws and levels known")
    for column in (
        "case",
        "parameter",
        "true",
        "mean error",
        "scatter",
        "honest",
        "pull",
        "within 2",
        "within 1 %",
        "s",
    ):
        table.add_column(column, justify="left" if column in ("case", "parameter") else "right")
    for case in cases:
        started_s = time.perf_counter()
        errors, stated, departures, names = [], [], [], set()
        for seed in range(n_seeds):
            finding, truth = series_of_twin(case, seed)
            names.add(finding.law_name)
            errors.append(finding.fit.parameters - truth)
            stated.append(np.sqrt(np.diag(finding.fit.covariance)))
            departures.append(intensity_departure(finding, truth))
        seconds = (time.perf_counter() - started_s) / n_seeds
        error, sigma = np.array(errors), np.array(stated)
        for i, name in enumerate(("r_resp", "r_expo", "r_const", "r_curve")[: 4 if case.r_curve else 3]):
            pull = error[:, i] / sigma[:, i]
            is_first = i == 0
            table.add_row(
                f"{case.name} ({', '.join(sorted(names))})" if is_first else "",
                name,
                f"{case.true_parameters[i]:.3f}",
                f"{error[:, i].mean():+.5f}",
                f"{error[:, i].std():.5f}",
                f"{sigma[:, i].mean() / error[:, i].std():.2f}",
                f"{np.sqrt(np.mean(pull**2)):.2f}",
                f"{np.mean(np.abs(pull) < 2.0):.1%}",
                f"{np.mean(np.array(departures) < 0.01):.1%}, median {np.median(departures):.2%}" if is_first else "",
                f"{seconds:.2f}" if is_first else "",
            )
    Console(width=170).print(table)


if __name__ == "__main__":
    chosen = [CASES[int(number)] for number in sys.argv[2:]] or CASES
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200, chosen)
