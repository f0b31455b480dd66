"""What `export --format sim_telarray` measures: the scatter of the facets' tilts over the zenith distance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.gravity_runs import GravityRuns, read_gravity_runs
from namod_ctl.calibration.gravity.random_alignment import TiltSpread, ZenithLaw, scatter_over_zenith, spread_of_run
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.raytrace import facet_moments, trace
from namod_ctl.optics.reflector import Reflector
from namod_ctl.store.export_sim_telarray import ScatterOfRuns
from namod_ctl.store.table_text import NUMBER

Array = NDArray[np.float64]

MAX_ZENITH_DEG = 90.0
FAR_OFF = 6.0
"""Robust standard deviations: of 1000 facets with Gaussian tilts none lies beyond."""
MEDIAN_OF_GAUSSIAN = 0.6745  # of the absolute value, in standard deviations
N_RAYS = 300
NOWHERE_DEG = (0.0,)
"""Stands for the zenith distance of a single run: its scatter is the same wherever it was."""


def zenith_distances_deg(text: str | None, n_runs: int) -> list[float] | None:
    """Zenith distances of the runs from the option's text; None without one.

    Raises
    ------
    ConfigError
        The text is no list of as many angles as there are runs.
    """
    if text is None:
        return None
    angles_deg = []
    for field in text.split(","):
        number = field.strip()
        if not NUMBER.fullmatch(number) or not 0.0 <= float(number) <= MAX_ZENITH_DEG:
            raise ConfigError(f"--zenith-deg: {number!r} is no zenith distance; give 0 to {MAX_ZENITH_DEG:.0f}, in deg")
        angles_deg.append(float(number))
    if len(angles_deg) != n_runs:
        raise ConfigError(f"--zenith-deg: {len(angles_deg)} zenith distances for {n_runs} runs; give one per run")
    return angles_deg


def scatter_of_runs(folders: Sequence[Path], zenith_deg: Sequence[float] | None) -> tuple[ScatterOfRuns, list[str]]:
    """Scatter of the tilts in every run and its law, and what is to be said about the facets.

    Raises
    ------
    ConfigError
        A run is not reconstructed, or not of the same telescope and state as the others, or its zenith distance is
        unknown where there are several.
    DataQualityError
        Too few runs or facets, about the same zenith distance, or facets that were turned between the runs.
    """
    is_named = len(folders) > 1 or zenith_deg is not None
    read = read_gravity_runs(folders, zenith_deg if is_named else NOWHERE_DEG, None, None)
    zenith_rad = np.array([run.path.mean_rad for run in read.runs]) if is_named else None
    reflector, remarks = read.instrument.reflector, list(read.remarks) if is_named else []
    if len(folders) == 1:
        spreads: tuple[TiltSpread, ...] = (spread_of_run(read.runs[0]),)
        law_x, law_y = (ZenithLaw(float(sigma), 0.0, 0.0, 0.0) for sigma in spreads[0].sigma_rad)
        left_out = np.asarray(~np.isfinite(read.runs[0].theta_rad).all(axis=1))
    else:
        scatter = scatter_over_zenith(read.runs, read.light)
        spreads, (law_x, law_y), left_out = scatter.at_runs, scatter.laws, scatter.left_out
        remarks += scatter.remarks
    if left_out.any():
        remarks.append(
            f"Left out, with no reliable estimate or no sag like the others': facets {_names(reflector, left_out)}."
        )
    far_off = _far_off(read.runs) & ~left_out
    if far_off.any():
        remarks.append(f"In the rms, but far beyond all others: facets {_names(reflector, far_off)}.")
    return ScatterOfRuns(zenith_rad, spreads, (law_x, law_y), _extra_blur_rad(read)), remarks


def _names(reflector: Reflector, which: NDArray[np.bool_]) -> str:
    return " ".join(str(facet_id) for facet_id, is_named in zip(reflector.ids, which, strict=True) if is_named)


def _far_off(runs: Sequence[RunOfFacets]) -> NDArray[np.bool_]:
    """Shape (n_facets,). Facets that make a Gaussian of the rms a poor picture of all others."""
    theta = np.array([run.theta_rad for run in runs])
    offset = np.abs(theta - np.nanmedian(theta, axis=1, keepdims=True))
    sigma = np.nanmedian(offset, axis=1, keepdims=True) / MEDIAN_OF_GAUSSIAN
    return np.asarray(np.any(offset > FAR_OFF * sigma, axis=(0, 2)))


def _extra_blur_rad(read: GravityRuns) -> float:
    """How much wider the facets' images are than those of ideal facets, rms per axis, median; NaN if they are not."""
    reflector = read.instrument.reflector
    ideal = facet_moments(trace(reflector, N_RAYS)).cov_m2 / reflector.focal_length_m**2
    excess = float(np.median(read.variance_rad2 - np.trace(ideal, axis1=1, axis2=2) / 2.0))
    return float(np.sqrt(excess)) if excess > 0.0 else np.nan
