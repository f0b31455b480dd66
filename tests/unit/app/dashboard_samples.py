"""Runs and campaigns without cameras, for the tests of the page."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.core.units import deg_to_rad
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.run import RunStore

TOKEN = "a token for the tests"
EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>"


def small_config(name: str = "Mini") -> InstrumentConfig:
    """Mini FACT under another name."""
    config = load_config("mini_fact")
    return config.model_copy(update={"telescope": config.telescope.model_copy(update={"name": name})})


def new_run(path: Path, name: str = "Mini") -> RunStore:
    """An empty run, open for writing."""
    config = small_config(name)
    return RunStore.create(path, [facet.id for facet in config.facets], config.to_json(), "a test", SystemClock())


def new_campaign(path: Path, name: str = "Mini") -> CampaignStore:
    """A campaign that records its first cycle, open for writing."""
    store = CampaignStore.create(path, small_config(name).to_json(), "a test", SystemClock())
    store.add_transition("idle", "recording", "start", "asked for")
    return store


def record(index: int, n_facets: int, reject_reason: RejectReason | None = None) -> Record:
    """A record on a spiral around the axis; facet j is brightest where the spiral is after j records."""
    angle, radius_rad = 0.7 * index, deg_to_rad(0.02 * math.sqrt(index % 300))
    theta_rad = radius_rad * np.array([math.cos(angle), math.sin(angle)])
    return Record(
        index=index,
        label=f"record {index}",
        theta_rad=theta_rad,
        theta_uncertainty_rad=1e-6,
        star_intensity=2.0,
        facet_intensity=np.exp(-np.abs(np.arange(n_facets) - index % n_facets) / 2.0),
        facet_saturated_share=np.zeros(n_facets),
        star_exposure_s=0.02,
        reflector_exposure_s=0.5,
        reject_reason=reject_reason,
        detail="" if reject_reason is None else "seen by the test",
        star_mid_exposure_s=float(index),
        reflector_mid_exposure_s=float(index),
    )
