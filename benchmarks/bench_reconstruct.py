"""How the default estimator grows: 5000 records x 30 to 1000 facets, the whole path from table to alignment.

Run: python benchmarks/bench_reconstruct.py

Every size runs in a process of its own, so that its peak memory is its own. Printed beside the exponent with which time
grew since the size before (time ~ size^exponent; 1 is linear, less is better), and beside the single pass over the
table that any estimator must make (numpy's argmax per facet), as the floor.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.reflector import Reflector
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import ResponseTable

SIZES = ((1250, 100), (5000, 100), (5000, 300), (5000, 1000))
LIMIT_S, LIMIT_GIB = 60.0, 2.0  # for the largest size, on two cores
SCAN_RADIUS_RAD = deg_to_rad(0.35)
PSF_SIGMA_RAD = arcmin_to_rad(1.2)


def make_table(n_records: int, n_facets: int, seed: int = 1) -> tuple[ResponseTable, np.ndarray]:
    """Records spread evenly over the scan; facets of two unequal spots, so that no gaussian fits them exactly."""
    rng = np.random.default_rng(seed)
    radius, angle = SCAN_RADIUS_RAD * np.sqrt(rng.random(n_records)), 2.0 * np.pi * rng.random(n_records)
    theta = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    centres = rng.normal(0.0, arcmin_to_rad(4.0), (n_facets, 2))
    response = np.empty((n_records, n_facets))
    for j, centre in enumerate(centres):
        split = rng.normal(0.0, 0.6 * PSF_SIGMA_RAD, 2)
        spots = ((0.6, centre + 0.4 * split), (0.4, centre - 0.6 * split))
        light = sum(
            share * np.exp(-0.5 * ((theta - spot) ** 2).sum(axis=1) / PSF_SIGMA_RAD**2) for share, spot in spots
        )
        response[:, j] = light * np.exp(0.05 * rng.standard_normal(n_records)) + 1e-3 * rng.random(n_records)
    n = np.arange(n_records)
    return ResponseTable(
        tuple(range(n_facets)), n, theta, np.full(n_records, np.nan), response, np.ones(n_records)
    ), centres


def make_instrument(n_facets: int) -> Instrument:
    """FACT's cameras and mounts with a reflector of as many facets as wanted; where they stand plays no part."""
    fact = build_instrument(load_config("fact"))
    template = fact.reflector.facets[0]
    facets = tuple(replace(template, id=j) for j in range(n_facets))
    mounts = dict.fromkeys(range(n_facets), fact.mounts[template.id])
    return replace(fact, reflector=Reflector(fact.reflector.focal_length_m, facets), mounts=mounts)


def measure(n_records: int, n_facets: int) -> dict[str, float]:
    table, truth = make_table(n_records, n_facets)
    instrument = make_instrument(n_facets)
    start = time.perf_counter()
    np.argmax(table.response, axis=0)
    floor_s = time.perf_counter() - start
    start = time.perf_counter()
    alignment = reconstruct(table, instrument).alignment
    elapsed_s = time.perf_counter() - start
    error = np.array([facet.theta_rad for facet in alignment.facets]) - truth
    return {
        "elapsed_s": elapsed_s,
        "floor_s": floor_s,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "rms_arcmin": float(np.sqrt(np.mean(error**2)) / arcmin_to_rad(1.0)),
        "n_bad": len(alignment.bad_records),
    }


def main() -> None:
    print("records facets   time/s  growth exponent  floor passes  peak/GiB  rms/arcmin  false alarms")
    before: tuple[float, float] | None = None
    for n_records, n_facets in SIZES:
        done = subprocess.run(
            [sys.executable, __file__, str(n_records), str(n_facets)], check=True, capture_output=True, text=True
        )
        figures = json.loads(done.stdout)
        here = (np.log(figures["elapsed_s"]), np.log(n_records * n_facets))
        growth = "" if before is None else f"{(here[0] - before[0]) / (here[1] - before[1]):.2f}"
        before = here
        print(
            f"{n_records:7d} {n_facets:6d} {figures['elapsed_s']:8.1f}  {growth:>15s}  "
            f"{figures['elapsed_s'] / figures['floor_s']:12.0f}  {figures['peak_gib']:8.2f}  "
            f"{figures['rms_arcmin']:10.3f}  {figures['n_bad']:12d}"
        )
    print(
        f"largest size: {figures['elapsed_s'] / LIMIT_S:.2f} of the {LIMIT_S:.0f} s and "
        f"{figures['peak_gib'] / LIMIT_GIB:.2f} of the {LIMIT_GIB:.0f} GiB it may take"
    )


if __name__ == "__main__":
    if len(sys.argv) == 3:
        print(json.dumps(measure(int(sys.argv[1]), int(sys.argv[2]))))
    else:
        main()
