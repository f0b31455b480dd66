"""Where the telescope stood while a run was recorded, and when its facets were lit: what the run itself knows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.twin_note import noted_twin
from namod_ctl.app.config.schema import SiteSection
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.calibration.sky.observed_sky import Site
from namod_ctl.calibration.sky.star_catalogue import bright_stars, number_of_star
from namod_ctl.calibration.sky.star_path import apparent_path
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.store.run import RunStore
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.sky import Sky
from namod_ctl.twin.telescope import Telescope

Array = NDArray[np.float64]

MOST_MOMENTS = 50


@dataclass(frozen=True, slots=True, eq=False)
class SeenFacets:
    """When a run saw its facets.

    Attributes
    ----------
    times_s
        Shape (n_moments,). Moments evenly spread over the records that count, seconds since the run began.
    share
        Shape (n_facets, n_moments), in the order of the run's facet ids; of each facet's light, what came about then.
    """

    times_s: Array
    share: Array


def when_facets_were_seen(store: RunStore) -> SeenFacets | None:
    """The moments of a run and the facets' light at them; None for records that do not know their time."""
    records = [r for r in store.records() if r.reject_reason is None and math.isfinite(r.star_mid_exposure_s)]
    if not records:
        return None
    times_s = np.array([record.star_mid_exposure_s for record in records])
    records = [records[i] for i in np.argsort(times_s, kind="stable")]
    groups = np.array_split(np.arange(len(records)), min(len(records), MOST_MOMENTS))
    response = np.nan_to_num([record.facet_intensity / record.star_intensity for record in records])
    lit = np.maximum(response - np.median(response, axis=0), 0.0)
    light = np.array([lit[group].sum(axis=0) for group in groups]).T
    total = light.sum(axis=1, keepdims=True)
    share = np.where(total > 0.0, light / np.where(total > 0.0, total, 1.0), 1.0 / len(groups))
    moments_s = np.array([np.sort(times_s)[group].mean() for group in groups])
    return SeenFacets(moments_s, share)


def zenith_of_run(store: RunStore, times_s: Array) -> ZenithPath | None:
    """Zenith distances at moments (n,) of a run, seconds since it began; None when the run does not know them.

    A run of `namod-ctl record --twin` holds the twin's sky and its stars. Its telescope's control would know, too,
    from which park position it came.

    Raises
    ------
    StoreError
        The twin noted in the run cannot be understood.
    """
    noted = noted_twin(store)
    if noted is None:
        return None
    settings, seed = noted
    faults = FaultPlan()
    sky = Sky(settings.sky, settings.telescope, Telescope(settings.telescope, faults, seed), faults, seed)
    zenith_rad = np.array([sky.zenith_distance_rad(float(time_s)) for time_s in times_s])
    return ZenithPath(zenith_rad, settings.telescope.came_from_zenith_rad)


def zenith_of_star(store: RunStore, times_s: Array, star: str, section: SiteSection) -> ZenithPath:
    """Zenith distances of a star over a site at moments (n,) of a run, seconds as its records have them.

    A run's time begins when it was made. On which side the telescope was before nobody knows.

    Raises
    ------
    ConfigError
        There is no such star in the catalogue, or it had not risen.
    """
    catalogue = bright_stars()
    i = number_of_star(catalogue, star)
    begun = datetime.fromisoformat(store.created_utc)
    utc = [begun + timedelta(seconds=float(time_s - times_s[0])) for time_s in times_s]
    site = Site(deg_to_rad(section.latitude_deg), deg_to_rad(section.longitude_deg), section.altitude_m)
    try:
        path = apparent_path(utc, float(catalogue.ra_rad[i]), float(catalogue.dec_rad[i]), site)
    except ConfigError as problem:
        raise ConfigError(f"{store.path}: {star}: {problem}") from None
    return ZenithPath(np.arccos(path.direction[:, 2]))
