"""Runs of the twin at several zenith distances, as if reconstructed, and look-up tables of known content."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from output_samples import alignment_of, facet_alignment

from namod_ctl.app.alignment_files import write_alignment
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.build.twin_note import note_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.lut.files import Lut, LutRun, lut_to_json
from namod_ctl.calibration.gravity.gravity_table import GravityTable
from namod_ctl.core.clock import Clock, SystemClock
from namod_ctl.core.records import Record
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.store.run import RunStore
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import ReflectorSettings, SkySettings, TwinSettings
from namod_ctl.twin.sky import CATALOGUE

SEED = 1
SAG_ARCMIN = 3.0
ERROR_RAD = arcmin_to_rad(0.05)
REFLECTOR = ReflectorSettings(sag_rad=arcmin_to_rad(SAG_ARCMIN))


def config() -> InstrumentConfig:
    return load_config("fact_actuated")


def twin_reflector() -> TwinReflector:
    return build_twin(config(), TwinSettings(reflector=REFLECTOR), SEED).reflector


def sky_at(zenith_deg: float) -> SkySettings:
    """Vega sets through that zenith distance at the clock's zero."""
    sky, star = SkySettings(), CATALOGUE["Vega"]
    cosine = (math.cos(deg_to_rad(zenith_deg)) - math.sin(sky.latitude_rad) * math.sin(star.declination_rad)) / (
        math.cos(sky.latitude_rad) * math.cos(star.declination_rad)
    )
    return replace(sky, sidereal_time_rad=star.right_ascension_rad + math.acos(min(cosine, 1.0)))


def run_at(
    folder: Path,
    zenith_deg: float,
    reflector: TwinReflector,
    *,
    knows_zenith: bool = True,
    used: InstrumentConfig | None = None,
    clock: Clock | None = None,
) -> Path:
    """A run of some records and its alignment.json, in which facets stand as the twin's truth has them."""
    run = folder / f"run_{zenith_deg:g}"
    ids = [facet.id for facet in config().facets]
    rng = np.random.default_rng(int(zenith_deg))
    used, clock = used or config(), clock or SystemClock()
    with RunStore.create(run, ids, used.to_json(), "made up", clock) as store:
        store.append(
            Record(i, "", np.zeros(2), 1e-6, 1.0, rng.random(len(ids)), np.zeros(len(ids)), 0.1, 0.1,
                   star_mid_exposure_s=10.0 * i, reflector_mid_exposure_s=10.0 * i)
            for i in range(12)
        )  # fmt: skip
        if knows_zenith:
            note_twin(store, TwinSettings(reflector=REFLECTOR, sky=sky_at(zenith_deg)), SEED)
    truth = reflector.truth
    sag = np.einsum("fab,fb->fa", truth.theta_per_tilt, reflector.sag_rad(deg_to_rad(zenith_deg)))
    theta = truth.theta_rad + sag + ERROR_RAD * rng.standard_normal((len(ids), 2))
    facets = [
        replace(facet_alignment(facet_id), theta_rad=theta[j], theta_cov_rad2=ERROR_RAD**2 * np.eye(2))
        for j, facet_id in enumerate(reflector.ids)
    ]
    write_alignment(run, alignment_of(facets))
    return run


def true_lut(reflector: TwinReflector) -> Lut:
    """The table of the twin's own sag, without errors."""
    truth, light = reflector.truth, reflector.light_m2 / reflector.light_m2.sum()
    sine = np.einsum("fab,fb->fa", truth.theta_per_tilt, reflector.sag_rad(math.pi / 2.0))
    beta = np.stack([truth.theta_rad - light @ truth.theta_rad, sine - light @ sine], axis=1)
    n = len(reflector.ids)
    table = GravityTable(
        telescope="FACT",
        facet_ids=reflector.ids,
        terms=("sin",),
        beta_rad=beta,
        cov_rad2=np.zeros((n, 2, 2, 2, 2)),
        is_moving=np.ones(n, dtype=np.bool_),
        light=light,
        variance_rad2=np.full(n, arcmin_to_rad(1.45) ** 2),
        zenith_range_rad=(deg_to_rad(10.0), deg_to_rad(60.0)),
    )
    run = LutRun(
        name="run_10",
        zenith_deg=10.0,
        zenith_first_deg=10.0,
        zenith_last_deg=10.0,
        came_from="unknown",
        common_deg=[0.0, 0.0],
        common_uncertainty_deg=[0.001, 0.001],
    )
    return Lut(
        table=table, made_utc="2026-01-01T00:00:00+00:00", is_good=True, remarks=("made up",), scatter=1.0,
        residual_rms_rad=0.0, hysteresis=None, tests=(), runs=(run,), chance=np.zeros(n), facet_remarks=("",) * n,
    )  # fmt: skip


def write_lut(path: Path, lut: Lut) -> Path:
    path.write_text(lut_to_json(lut))
    return path
