"""How well a run tells that responses depend on the star's brightness, and what the self-calibration leaves of it.

Run: python benchmarks/bench_normalization.py [--made 20] [--twin 2] [--records 500]

The slope put in is 0 or the paper's, -6.9 % per magnitude (arXiv:1605.06274, section 3). Made runs come from the
generator of the tests, which throws rays; twin nights go through exposure loop, images, and measurement. There the law
of the reflector camera's exposures is wrong, so the true slope of each night is worked out from the exposures it had:
the same records with the wrong law divided out are measured again. Columns: `error` (rms over seeds) and `stated`
uncertainty of the measured slope; what the self-calibration `left` of the true slope (rms, and the worst seed); by
how much it `moved` the facets' centres (rms, and the most any facet moved) in their stated uncertainties per axis; and
the centres' errors against the truth with the self-calibration off and on, arcmin rms per axis.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_arcmin
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.normalization import PER_MAGNITUDE
from namod_ctl.reconstruction.reconstruct import fit_run, reconstruct
from namod_ctl.reconstruction.responses import ResponseTable, tabulate_responses
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import (
    REFLECTOR_CAMERA,
    FaultSpec,
    ReflectorSettings,
    SkySettings,
    TelescopeSettings,
    TwinSettings,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "reconstruction"))
from response_maker import disc, instrument, make_run
from star_maker import clouds, stars, under_star

PAPER_PER_MAGNITUDE = -0.069
EXPONENT = math.log1p(PAPER_PER_MAGNITUDE) / PER_MAGNITUDE
LAW_ERROR = 10.0**EXPONENT - 1.0
REGION_RAD = deg_to_rad(0.12)
MISALIGNMENT_RAD = arcmin_to_rad(1.0)


@dataclass(frozen=True)
class Night:
    """Slopes in % per magnitude."""

    true: float
    measured: float
    uncertainty: float
    left: float
    moved_rms_sigma: float
    moved_most_sigma: float
    error_on_rad: float
    error_off_rad: float


def judge(table: ResponseTable, telescope: Instrument, true_exponent: float, centre_rad: np.ndarray) -> Night | None:
    """None where the run carries too little information."""
    on, off = (reconstruct(table, telescope, self_calibration=is_on) for is_on in (True, False))
    found = on.normalization
    if not found.is_known:
        return None
    here, there = (np.array([facet.theta_rad for facet in run.alignment.facets]) for run in (on, off))
    cov = np.array([facet.theta_cov_rad2 for facet in on.alignment.facets])
    known = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    here, there, cov, centre_rad = here[known], there[known], cov[known], centre_rad[known]
    sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2.0)
    moved = np.linalg.norm(here - there, axis=1) / sigma
    return Night(
        true=100.0 * math.expm1(PER_MAGNITUDE * true_exponent),
        measured=100.0 * found.per_magnitude,
        uncertainty=100.0 * found.per_magnitude_uncertainty,
        left=100.0 * math.expm1(PER_MAGNITUDE * (true_exponent - on.removed_exponent)),
        moved_rms_sigma=float(np.sqrt(np.mean(moved**2))),
        moved_most_sigma=float(moved.max()),
        error_on_rad=float(np.sqrt(np.mean((here - centre_rad) ** 2))),
        error_off_rad=float(np.sqrt(np.mean((there - centre_rad) ** 2))),
    )


def made(seed: int, n_records: int, sky: Callable[..., np.ndarray], exponent: float) -> Night | None:
    rng = np.random.default_rng(seed)
    run = make_run(
        seed,
        n_records,
        path=lambda rng, n: disc(rng, n, REGION_RAD),
        misalignment_rad=MISALIGNMENT_RAD,
    )
    run = under_star(run, rng, sky(rng, n_records), exponent)
    return judge(run.table, instrument(len(run.centre_rad)), exponent, run.centre_rad)


TWIN_SKIES = {
    "clouds": (SkySettings(), (FaultSpec("clouds", params={"factor": 10.0, "period_s": 300.0}),)),
    "stars": (SkySettings(star_changes=((600.0, "Mizar"), (1200.0, "Deneb"), (1600.0, "Vega"))), ()),
}


def twin_night(seed: int, n_records: int, sky: str, law_error: float) -> Night | None:
    """A slow telescope and an aligned mirror: exposures follow the star, and many facets are lit at once."""
    settings = TwinSettings(
        ReflectorSettings(misalignment_rad=MISALIGNMENT_RAD),
        TWIN_SKIES[sky][0],
        TelescopeSettings("random", REGION_RAD, speed_rad_per_s=arcmin_to_rad(0.2)),
        reflector_camera=replace(REFLECTOR_CAMERA, law_error_per_decade=law_error),
        faults=TWIN_SKIES[sky][1],
    )
    config = load_config("fact")
    twin = build_twin(config, settings, seed)
    ids = [facet.id for facet in config.facets]
    truths: list[np.ndarray] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        RunStore.create(Path(folder) / "run", ids, config.to_json(), "", twin.wall_clock) as store,
    ):
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        recorder = Recorder(equipment, twin.instrument, store, RecordSettings(pace_s=4.0, region_radius_rad=REGION_RAD))
        recorder.record(StopRule(n_records=n_records), lambda progress: truths.append(twin.true_theta_rad))
        records = store.records()
    table = tabulate_responses(records, ids)
    true_exponent = 0.0
    if law_error:
        r_expo = twin.instrument.reflector_camera.law.r_expo
        power = r_expo - r_expo / (1.0 + math.log10(1.0 + law_error))
        exact = [
            replace(record, facet_intensity=record.facet_intensity / record.reflector_exposure_s**power)
            for record in records
        ]
        wrong, right = (fit_run(tabulate_responses(part, ids), twin.instrument) for part in (records, exact))
        true_exponent = wrong.normalization.exponent - right.normalization.exponent
    return judge(table, twin.instrument, true_exponent, np.mean(truths, axis=0))


def print_row(title: str, n_records: int, nights: list[Night | None]) -> None:
    known = [night for night in nights if night is not None]
    if not nights:
        return
    if not known:
        print(f"{title:17s}{n_records:8d}{0:4d}/{len(nights):<3d}  too little information")
        return
    true, measured, sigma, left = np.array([[n.true, n.measured, n.uncertainty, n.left] for n in known]).T
    moved, most, on, off = np.array(
        [[n.moved_rms_sigma, n.moved_most_sigma, n.error_on_rad, n.error_off_rad] for n in known]
    ).T
    error = measured - true
    pull = np.sqrt(np.mean((error / sigma) ** 2))
    print(
        f"{title:17s}{n_records:8d}{len(known):4d}/{len(nights):<3d}{true.mean():7.2f}{measured.mean():9.2f}"
        f"{np.sqrt(np.mean(error**2)):7.2f}{sigma.mean():8.2f}{pull:7.2f}{np.sqrt(np.mean(left**2)):7.2f}"
        f"{np.abs(left).max():7.2f}{np.sqrt(np.mean(moved**2)):7.2f}{most.max():6.2f}"
        f"{rad_to_arcmin(np.sqrt(np.mean(off**2))):9.3f}{rad_to_arcmin(np.sqrt(np.mean(on**2))):7.3f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--made", type=int, default=20, help="seeds of made runs")
    parser.add_argument("--twin", type=int, default=2, help="seeds of twin nights")
    parser.add_argument("--records", type=int, default=500)
    arguments = parser.parse_args()
    n = arguments.records
    print(
        f"{'% per magnitude':17s}{'records':>8s}{'known':>8s}{'true':>7s}{'measured':>9s}{'error':>7s}{'stated':>8s}"
        f"{'pulls':>7s}{'left':>7s}{'worst':>7s}{'moved':>7s}{'most':>6s}{'off':>9s}{'on':>7s}"
    )
    for sky in (clouds, stars):
        for exponent in (0.0, EXPONENT):
            nights = [made(seed, n, sky, exponent) for seed in range(7001, 7001 + arguments.made)]
            print_row(f"made, {sky.__name__}", n, nights)
    for name in TWIN_SKIES:
        for law_error in (0.0, LAW_ERROR):
            nights = [twin_night(seed, n, name, law_error) for seed in range(7001, 7001 + arguments.twin)]
            print_row(f"twin, {name}", n, nights)


if __name__ == "__main__":
    main()
