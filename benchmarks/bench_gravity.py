"""Gravity: is the twin's sag found, with honest errors, and does the look-up table keep the image at its limit?

Run: python benchmarks/bench_gravity.py [--seeds 20] [--sag-arcmin 1,3] [--chain]

Every seed is another telescope. Statistics rest on directions computed from the twin's truth with noise of the size
that reconstructed runs have; the whole chain (frames, recorder, reconstruction, table, drives) runs once with --chain,
which takes some minutes. A_sigma is ray traced with the twin's true facets and divided by that of the same facets
perfectly aligned. The facets are aligned perfectly at 30 deg; the play is taken up from the worse side.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.lut.files import read_lut
from namod_ctl.calibration.gravity.gravity_table import GravityTable, table_of_fit, zenith_grid_rad
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets, SagFit, fit_sag
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_arcmin, rad_to_deg
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import ReflectorSettings, SkySettings, TwinSettings
from namod_ctl.twin.sky import CATALOGUE

Array = NDArray[np.float64]

ALIGNED_RAD = deg_to_rad(30.0)
OWN_WIDTH_RAD = arcmin_to_rad(1.45)
NOISE_RAD, NOISE_SPREAD = arcmin_to_rad(0.05), 0.3
FLEXURE_RAD = arcmin_to_rad(0.5)  # of the star camera, from run to run
PLAY_RAD = deg_to_rad(2.0)
PASS_S = 1385.0  # in which the twin's telescope covers its region
PLANS: dict[str, list[tuple[float, str]]] = {
    "4 runs from above": [(10, "above"), (25, "above"), (40, "above"), (60, "above")],
    "4 runs, both sides": [(10, "above"), (25, "below"), (40, "above"), (60, "below")],
    "6 runs, both sides": [
        (10, "above"), (20, "below"), (30, "above"), (40, "below"), (50, "above"), (60, "below"),
    ],
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Of one telescope."""

    pulls: Array
    terms: tuple[str, ...]
    n_moving: int
    play: tuple[float, float] | None
    without: float
    with_table: float


def felt_rad(zenith_rad: float, side: str) -> float:
    """Zenith distance that a structure with the twin's play feels."""
    came_from = 0.0 if side == "above" else math.pi / 2.0
    return min(max(came_from, zenith_rad - PLAY_RAD), zenith_rad + PLAY_RAD)


def simulated_runs(reflector: TwinReflector, plan: list[tuple[float, str]], seed: int) -> list[RunOfFacets]:
    """What perfect reconstructions with honest errors would say."""
    rng = np.random.default_rng(seed)
    truth, runs = reflector.truth, []
    for zenith_deg, side in plan:
        zenith = deg_to_rad(zenith_deg)
        theta = truth.theta_rad + np.einsum(
            "fab,fb->fa", truth.theta_per_tilt, reflector.sag_rad(felt_rad(zenith, side))
        )
        sigma = NOISE_RAD * np.exp(NOISE_SPREAD * rng.standard_normal(len(theta)))
        theta = theta + sigma[:, None] * rng.standard_normal(theta.shape) + FLEXURE_RAD * rng.standard_normal(2)
        path = ZenithPath(np.array([zenith]), 0.0 if side == "above" else math.pi / 2.0)
        runs.append(
            RunOfFacets(f"{zenith_deg:g}", path, theta, (sigma**2)[:, None, None] * np.eye(2), np.ones((len(theta), 1)))
        )
    return runs


def true_terms(reflector: TwinReflector, light: Array) -> dict[str, Array]:
    """The twin's own coefficients, relative to the light-weighted mean of all facets, shape (n_facets, 2) each."""
    per_tilt = reflector.truth.theta_per_tilt
    # of the sag a sin z + b (1 - cos z): its values at the horizon and at 60 deg give both
    at_90, at_60 = reflector.sag_rad(math.pi / 2.0), reflector.sag_rad(math.pi / 3.0)
    sine = (at_60 - 0.5 * at_90) / (math.sqrt(3.0) / 2.0 - 0.5)
    tilts = {"sin": sine, "cos": -(at_90 - sine)}
    thetas = {term: np.einsum("fab,fb->fa", per_tilt, tilt) for term, tilt in tilts.items()}
    return {term: theta - light @ theta / light.sum() for term, theta in thetas.items()}


def pulls_of(fit: SagFit, truth: dict[str, Array]) -> Array:
    """(Found - true) / stated error of all terms that were found needed."""
    pulls = [
        (fit.beta_rad[:, i] - truth[term]) / np.sqrt(np.diagonal(fit.cov_rad2[:, i, :, i, :], axis1=1, axis2=2))
        for i, term in enumerate(fit.terms, start=1)
    ]
    return np.concatenate([pull.ravel() for pull in pulls]) if pulls else np.empty(0)


def worst_ratios(reflector: TwinReflector, table: GravityTable) -> tuple[float, float]:
    """Largest A_sigma from 5 to 65 deg over that of the same facets aligned: without the table, and with it."""
    for _ in range(2):
        reflector.apply_correction(reflector.correction_at_rad(ALIGNED_RAD))
    limit, without, with_table = reflector.a_sigma_aligned_rad2(), [], []
    for zenith in zenith_grid_rad(deg_to_rad(5.0), deg_to_rad(65.0), deg_to_rad(10.0)):
        turn = table.tilt_change_rad(ALIGNED_RAD, float(zenith))
        for side in ("above", "below"):
            felt = felt_rad(float(zenith), side)
            without.append(reflector.a_sigma_at_rad2(felt))
            reflector.apply_correction(turn)
            with_table.append(reflector.a_sigma_at_rad2(felt))
            reflector.apply_correction(-turn)
    return max(without) / limit, max(with_table) / limit


def study(seed: int, sag_arcmin: float, bending_arcmin: float, plan: list[tuple[float, str]]) -> Outcome:
    settings = ReflectorSettings(
        sag_rad=arcmin_to_rad(sag_arcmin), bending_rad=arcmin_to_rad(bending_arcmin), sag_hysteresis_rad=PLAY_RAD
    )
    reflector = build_twin(load_config("fact_actuated"), TwinSettings(reflector=settings), seed).reflector
    light = reflector.light_m2
    fit = fit_sag(simulated_runs(reflector, plan, seed), light)
    pulls = pulls_of(fit, true_terms(reflector, light))
    width = np.full(len(light), OWN_WIDTH_RAD**2)
    reach = (deg_to_rad(plan[0][0]), deg_to_rad(plan[-1][0]))
    table = table_of_fit(fit, "FACT", reflector.ids, light, width, reach)
    play = None if fit.play is None else (fit.play.play_rad, fit.play.sigma_rad)
    return Outcome(pulls, fit.terms, int(fit.is_moving.sum()), play, *worst_ratios(reflector, table))


def statistics(n_seeds: int, sags_arcmin: list[float]) -> None:
    print(f"{n_seeds} telescopes each; play of the twin {rad_to_deg(PLAY_RAD):g} deg")
    print(
        f"{'sag/arcmin':>10s} {'bending':>7s} {'plan':20s} {'pulls: mean':>11s} {'rms':>5s} {'>3':>6s} {'terms':>18s} "
        f"{'moving':>6s} {'play/deg':>13s} {'pull':>5s} {'worst without':>13s} {'with table':>10s}"
    )
    for sag_arcmin in sags_arcmin:
        for bending_arcmin in (0.0, sag_arcmin):
            for name, plan in PLANS.items():
                found = [study(seed, sag_arcmin, bending_arcmin, plan) for seed in range(1, n_seeds + 1)]
                pulls = np.concatenate([outcome.pulls for outcome in found])
                terms = {outcome.terms for outcome in found}
                counts = " ".join(f"{'+'.join(t) or 'none'}:{sum(o.terms == t for o in found)}" for t in sorted(terms))
                plays = np.array([outcome.play for outcome in found if outcome.play is not None])
                play, pull = "", ""
                if len(plays):
                    play = f"{rad_to_deg(plays[:, 0].mean()):.2f} +- {rad_to_deg(plays[:, 0].std()):.2f}"
                    pull = f"{np.sqrt(np.mean(((plays[:, 0] - PLAY_RAD) / plays[:, 1]) ** 2)):.2f}"
                print(
                    f"{sag_arcmin:10.2f} {bending_arcmin:7.2f} {name:20s} {pulls.mean():11.2f} "
                    f"{np.sqrt(np.mean(pulls**2)):5.2f} {np.mean(np.abs(pulls) > 3.0):6.3f} {counts:>18s} "
                    f"{np.mean([outcome.n_moving for outcome in found]):6.1f} {play:>13s} {pull:>5s} "
                    f"{max(outcome.without for outcome in found):13.3f} {max(o.with_table for o in found):10.3f}",
                    flush=True,
                )


def sky_at(zenith_deg: float, side: str) -> tuple[SkySettings, float]:
    """A sky in which Vega stands there in the middle of a run, and the park position; it sets after one from above."""
    sky, star = SkySettings(), CATALOGUE["Vega"]
    cosine = (math.cos(deg_to_rad(zenith_deg)) - math.sin(sky.latitude_rad) * math.sin(star.declination_rad)) / (
        math.cos(sky.latitude_rad) * math.cos(star.declination_rad)
    )
    hour_angle = math.acos(min(cosine, 1.0)) * (1.0 if side == "above" else -1.0)
    middle = star.right_ascension_rad + hour_angle
    start = middle - math.tau * PASS_S / 2.0 / 86164.1
    return replace(sky, sidereal_time_rad=start), (0.0 if side == "above" else math.pi / 2.0)


def chain(folder: Path, sag_arcmin: float, n_records: int, plan: list[tuple[float, str]], seed: int = 1) -> None:
    """Everything by the commands themselves, as a crew would."""

    def run(*words: str) -> str:
        command = [sys.executable, "-c", "from namod_ctl.app.cli import main; main()", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(words)}: {done.stderr}\n{done.stdout}")
        return done.stdout

    runs = []
    for number, (zenith_deg, side) in enumerate(plan):
        sky, came_from = sky_at(zenith_deg, side)
        spacing_arcmin = 1.0 + 0.03 * number  # no two nights wander along the same path
        settings = folder / f"z{zenith_deg:g}.toml"
        settings.write_text(
            f"[reflector]\nsag_arcmin = {sag_arcmin}\nsag_hysteresis_deg = {rad_to_deg(PLAY_RAD)}\n"
            f"[sky]\nsidereal_time_rad = {sky.sidereal_time_rad}\n"
            f"[telescope]\ncame_from_zenith_rad = {came_from}\nspacing_arcmin = {spacing_arcmin}\n"
        )
        out = folder / f"RUN{zenith_deg:g}"
        run("record", "--twin", "--config", "fact_actuated", "--seed", str(seed), "--twin-settings", str(settings),
            "--out", str(out), "--records", str(n_records))  # fmt: skip
        run("reconstruct", str(out))
        runs.append(str(out))
    lut = folder / "LUT.json"
    print(run("lut", "fit", *runs, "--out", str(lut)))
    reflector_settings = ReflectorSettings(sag_rad=arcmin_to_rad(sag_arcmin), sag_hysteresis_rad=PLAY_RAD)
    reflector = build_twin(load_config("fact_actuated"), TwinSettings(reflector=reflector_settings), seed).reflector
    read = read_lut(lut)
    light = reflector.light_m2
    truth = true_terms(reflector, light)
    for i, term in enumerate(read.table.terms, start=1):
        sigma = np.sqrt(np.diagonal(read.table.cov_rad2[:, i, :, i, :], axis1=1, axis2=2))
        error = read.table.beta_rad[:, i] - truth[term]
        size, rms, pull = (math.sqrt(np.mean(v**2)) for v in (truth[term], error, error / sigma))
        true, off = rad_to_arcmin(size), rad_to_arcmin(rms)
        print(f"{term}: true rms {true:.3f} arcmin, error rms {off:.3f} arcmin, pulls rms {pull:.2f}")
    print(run("lut", "show", str(lut), "--aligned-at-deg", "30", "--out", str(folder)))
    settings = folder / "z25.toml"
    words = ["--twin", "--seed", str(seed), "--twin-settings", str(settings), "--yes"]
    for goal_deg in ("5", "15", "40", "65", "65"):
        told = run("lut", "apply", str(lut), "--zenith-deg", goal_deg, "--aligned-at-deg", "30", *words)
        print(f"apply {goal_deg}: {' '.join(told.splitlines()[-3:])}")
    without, with_table = worst_ratios(reflector, read.table)
    print(f"ray traced, worst from 5 to 65 deg: without the table {without:.3f}, with it {with_table:.3f} of the limit")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--sag-arcmin", default="1,3")
    parser.add_argument("--chain", action="store_true", help="record, reconstruct, fit and apply with the commands")
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--keep", type=Path, help="folder for the files of the chain")
    arguments = parser.parse_args()
    sags_arcmin = [float(sag) for sag in arguments.sag_arcmin.split(",")]
    if arguments.chain:
        with tempfile.TemporaryDirectory() as folder:
            chain(arguments.keep or Path(folder), sags_arcmin[0], arguments.records, PLANS["4 runs, both sides"])
    else:
        statistics(arguments.seeds, sags_arcmin)


if __name__ == "__main__":
    main()
