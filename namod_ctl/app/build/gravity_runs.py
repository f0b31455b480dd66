"""Reconstructed runs at several zenith distances, brought together for a look-up table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.alignment_files import read_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.run_zenith import when_facets_were_seen, zenith_of_run, zenith_of_star
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.store.run import RunStore

Array = NDArray[np.float64]

_SAME_POSITION_M = 0.01
_NOT_TO_BE_USED = FacetFlag.NO_SIGNAL | FacetFlag.UNRELIABLE | FacetFlag.PSF_OUTSIDE_SCAN
CAME_FROM_RAD = {"above": 0.0, "below": deg_to_rad(90.0), "unknown": math.nan}


@dataclass(frozen=True, slots=True, eq=False)
class GravityRuns:
    """Runs of one telescope.

    Attributes
    ----------
    light, variance_rad2
        Shape (n_facets,). Each facet's share of the light, and the variance per axis of its own; medians of the runs.
    remarks
        For a person.
    """

    instrument: Instrument
    facet_ids: tuple[int, ...]
    runs: tuple[RunOfFacets, ...]
    light: Array
    variance_rad2: Array
    remarks: tuple[str, ...]


def read_gravity_runs(
    folders: Sequence[Path],
    zenith_deg: Sequence[float] | None,
    stars: Sequence[str] | None,
    sides: Sequence[str] | None,
) -> GravityRuns:
    """The runs in these folders, in their order.

    Parameters
    ----------
    zenith_deg
        Of each run; None for runs that know it themselves.
    stars
        On which each run was recorded, for the zenith distance over the config's site; None as `zenith_deg`.
    sides
        From which side the telescope came to each, "above", "below" or "unknown"; None as `zenith_deg`.

    Raises
    ------
    ConfigError
        No runs, not reconstructed, named twice, copies of one another, of several telescopes, of a campaign that
        corrected between them, or of unknown zenith distance.
    """
    folders = [folder.resolve() for folder in folders]
    twice = sorted({str(folder) for folder in folders if folders.count(folder) > 1})
    if twice:
        raise ConfigError(f"{', '.join(twice)}: is named twice; name each run once")
    for folder in folders:
        check_run(folder)
    _refuse_corrected(folders)
    read = [_read(folder, None if stars is None else stars[k]) for k, folder in enumerate(folders)]
    instrument = read[0].instrument
    for folder, one in zip(folders, read, strict=True):
        _refuse_other_telescope(folders[0], instrument, folder, one.instrument)
    _refuse_copies(folders, [one.alignment for one in read])
    facet_ids = instrument.reflector.ids
    names = _names(folders)
    runs = []
    for k, one in enumerate(read):
        used, seen = one.path, one.seen
        if zenith_deg is not None:
            used, seen = ZenithPath(np.array([deg_to_rad(zenith_deg[k])])), np.ones((len(one.facet_ids), 1))
        if used is None:
            raise ConfigError(
                f"{folders[k]}: the run does not know its zenith distance; give those of all runs, in the order of the "
                "runs: --zenith-deg 10,25,40,60, or the star: --star Vega"
            )
        if sides is not None:
            used = replace(used, came_from_rad=CAME_FROM_RAD[sides[k]])
        runs.append(_run_of_facets(names[k], used, seen, one, facet_ids))
    light, variance_rad2 = _light([one.alignment for one in read], facet_ids)
    remarks = []
    if zenith_deg is not None and any(one.path is not None for one in read):
        remarks.append("zenith distances are those given by hand, not those that the runs know")
    return GravityRuns(instrument, facet_ids, tuple(runs), light, variance_rad2, tuple(remarks))


@dataclass(frozen=True, slots=True, eq=False)
class _Read:
    """A run as it lies on the disk; without a path it does not know its zenith distance."""

    instrument: Instrument
    alignment: Alignment
    facet_ids: tuple[int, ...]
    path: ZenithPath | None
    seen: Array


def _read(folder: Path, star: str | None) -> _Read:
    with RunStore.open(folder) as store:
        config = InstrumentConfig.from_json(store.config_json, f"{folder}: config")
        instrument = build_instrument(config)
        when = when_facets_were_seen(store)
        path = None if when is None else zenith_of_run(store, when.times_s)
        if star is not None:
            if when is None or config.site is None:
                what = "its records have no times" if when is None else "its config has no [site]"
                raise ConfigError(f"{folder}: {what}, so --star tells nothing; give --zenith-deg for all runs")
            path = zenith_of_star(store, when.times_s, star, config.site)
        seen = np.ones((len(store.facet_ids), 1)) if when is None else when.share
        return _Read(instrument, read_alignment(folder), store.facet_ids, path, seen)


def _names(folders: Sequence[Path]) -> list[str]:
    """Names by which people tell runs apart: the folders', with the folder above where these are alike."""
    names = [folder.name for folder in folders]
    return [
        name if names.count(name) == 1 else f"{folder.parent.name}/{name}"
        for folder, name in zip(folders, names, strict=True)
    ]


def _refuse_other_telescope(first: Path, instrument: Instrument, folder: Path, other: Instrument) -> None:
    places = {facet.id: facet.position_m for facet in instrument.reflector.facets}
    is_other = (
        other.name != instrument.name
        or set(other.reflector.ids) != set(places)
        or any(np.linalg.norm(f.position_m - places[f.id]) > _SAME_POSITION_M for f in other.reflector.facets)
    )
    if is_other:
        raise ConfigError(
            f"{folder}: is a run of {other.name}, with other facets than {first} of {instrument.name}; name runs of "
            "one telescope"
        )


def _refuse_copies(folders: Sequence[Path], alignments: Sequence[Alignment]) -> None:
    """Raise ConfigError for two runs with the very same estimates: noise makes every run its own."""
    first_of: dict[tuple[tuple[int, float, float], ...], Path] = {}
    for folder, alignment in zip(folders, alignments, strict=True):
        finite = [facet for facet in alignment.facets if np.isfinite(facet.theta_rad).all()]
        found = tuple((facet.facet_id, float(facet.theta_rad[0]), float(facet.theta_rad[1])) for facet in finite)
        if found and found in first_of:
            raise ConfigError(
                f"{folder}: has the very same estimates as {first_of[found]}, so it is a copy of that run; name each "
                "run once"
            )
        first_of[found] = folder


def _refuse_corrected(folders: Sequence[Path]) -> None:
    """Raise ConfigError for two runs of one campaign between which it turned facets."""
    for campaign in {folder.parent for folder in folders if is_campaign(folder.parent)}:
        own = [folder for folder in folders if folder.parent == campaign]
        if len(own) < 2:
            continue
        with CampaignStore.open(campaign) as store:
            number_of = {store.run_path(cycle.number).name: cycle.number for cycle in store.cycles()}
            turned = {order.cycle for order in store.orders()}
            turned |= {turn.cycle for number in number_of.values() for turn in store.turns(number) if turn.is_done}
        cycles = sorted(number_of[folder.name] for folder in own if folder.name in number_of)
        for before, after in pairwise(cycles):
            if any(before <= cycle < after for cycle in turned):
                raise ConfigError(
                    f"{campaign}: between its cycles {before} and {after} facets were turned, so these runs do not "
                    "show one state of the mirror; record runs at several zenith distances without a correction"
                )


def _run_of_facets(
    name: str, path: ZenithPath, seen_by_run: Array, read: _Read, facet_ids: Sequence[int]
) -> RunOfFacets:
    alignment = read.alignment
    theta = np.full((len(facet_ids), 2), np.nan)
    cov = np.full((len(facet_ids), 2, 2), np.nan)
    row_of = {facet_id: j for j, facet_id in enumerate(facet_ids)}
    seen = np.full((len(facet_ids), len(path.zenith_rad)), 1.0 / len(path.zenith_rad))
    for facet_id, share in zip(read.facet_ids, seen_by_run, strict=True):
        if facet_id in row_of:
            seen[row_of[facet_id]] = share
    for facet in alignment.facets:
        if facet.facet_id in row_of and not facet.flags & _NOT_TO_BE_USED:
            theta[row_of[facet.facet_id]] = facet.theta_rad
            cov[row_of[facet.facet_id]] = facet.theta_cov_rad2
    if not np.isfinite(cov).any():
        raise ConfigError(
            f"{name}: its alignment.json (estimator {alignment.estimator}) has no uncertainties; run namod-ctl "
            "reconstruct without --estimator"
        )
    return RunOfFacets(name, path, theta, cov, seen)


def _light(alignments: Sequence[Alignment], facet_ids: Sequence[int]) -> tuple[Array, Array]:
    """Light and variance per axis of every facet; where no run tells, those of the typical facet."""
    shares = np.full((len(alignments), len(facet_ids)), np.nan)
    variances = np.full_like(shares, np.nan)
    row_of = {facet_id: j for j, facet_id in enumerate(facet_ids)}
    for k, alignment in enumerate(alignments):
        for facet in alignment.facets:
            if facet.facet_id in row_of and facet.flux > 0.0:
                j = row_of[facet.facet_id]
                shares[k, j] = facet.flux
                variances[k, j] = (facet.width_major_rad**2 + facet.width_minor_rad**2) / 2.0
        shares[k] /= np.nanmedian(shares[k]) if np.isfinite(shares[k]).any() else 1.0
    light, variance = _median(shares), _median(variances)
    return light / light.sum(), variance


def _median(by_run: Array) -> Array:
    """Median over runs (n_runs, n_facets) of what is known; the median facet's where nothing is."""
    known = np.isfinite(by_run).any(axis=0)
    if not known.any():
        raise ConfigError("no run shows light of any facet; reconstruct them anew")
    median = np.empty(by_run.shape[1])
    median[known] = np.nanmedian(by_run[:, known], axis=0)
    median[~known] = np.median(median[known])
    return median
