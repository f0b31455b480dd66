"""Records that disagree with all others, found by their effect on all facets together, and named.

Every facet is a witness: given the fitted point spread functions, the set of facets that light up in a record says
where the star stood. A record is bad when another story explains its responses far better than its own:

`wrong_star`   the pattern belongs to another direction: the star camera measured a different star (or a reflection);
`cloud_edge`   the direction is right, all facets are too bright or too faint by one factor: the two cameras did not see
               the same transparency;
`stray_light`  the same amount of light lies on all facets, as no direction of the star can put it there.

Each story is compared by likelihood, with one free number (or three for a direction and a factor) paid for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import rad_to_deg
from namod_ctl.reconstruction.alignment import BadRecord
from namod_ctl.reconstruction.facet_fit import FacetFit, NoiseModel, student_loss, to_y, y_slope
from namod_ctl.reconstruction.facet_psf import evaluate
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

_EVIDENCE = 12.0  # natural log units a story must win by, beyond the price of its free numbers
_MIN_SHIFT_SIZES = 3.0  # a direction counts as another one from this many typical widths on
_MIN_FACTOR = 1.5  # transparency changes below this are the ordinary noise of a night
_LIT, _MIN_LIT = 0.1, 3  # share of its scale from which a facet is lit, and how many of them can vouch for a factor
_LOG_FACTORS = np.linspace(-2.4, 2.4, 13)
_DARK, _SHOT, _RELATIVE = 0.01, 0.1, 0.3  # least noise granted to a witness, see NoiseModel
_SIGMA_80 = 1.282  # 80 % of a gaussian lie within this many sigma
_MAX_GRID = 4000
_PRICE_PER_NUMBER = 3.0  # log of the choices one free number offers


@dataclass(frozen=True, slots=True, eq=False)
class _Witnesses:
    """Facets whose fits are compared with the records, as arrays over facets."""

    columns: list[int]
    scale: Array
    background: Array  # [facet], level of the dark records
    dark: Array  # [facet], scatter of the dark records about it with a star of typical brightness, of whatever cause
    light_at_records: Array  # [record, facet]
    model_variance: Array  # [record, facet], of the light, from the uncertainty of the fits


def find_bad_records(
    table: ResponseTable, fits: Sequence[FacetFit | None], noise: NoiseModel, typical_size_rad: float
) -> list[BadRecord]:
    """Bad records of a run, ascending by index; `fits` in the order of the table's facets."""
    # only real light is a testimony: darkness and fine detail of the fits are not held against a record
    noise = NoiseModel(max(noise.dark, _DARK), max(noise.shot, _SHOT), max(noise.relative, _RELATIVE))
    columns = [j for j, fit in enumerate(fits) if fit is not None]
    if len(columns) < 3:
        return []  # two witnesses can not outvote a star position
    facets = [fit for fit in fits if fit is not None]
    witnesses = _question(table, columns, facets)
    responses, light = table.response[:, columns], witnesses.light_at_records
    loss_here = _loss(responses, witnesses, light, noise, witnesses.model_variance, table.faintness[:, None])
    total = loss_here.sum(axis=1)
    # a story can win by no more than what the record has lost, so most records need no second look
    suspects = np.flatnonzero(total > _EVIDENCE)
    grid = _grid(table.theta_rad, typical_size_rad)
    light_on_grid = np.stack([evaluate(fit.parameters, grid)[0] for fit in facets], axis=1)
    found = []
    for i in suspects:
        bad = _judge(table, int(i), witnesses, loss_here[i], grid, light_on_grid, noise, typical_size_rad)
        if bad is not None:
            found.append(bad)
    return found


def _question(table: ResponseTable, columns: list[int], facets: list[FacetFit]) -> _Witnesses:
    light, variance, background, dark = [], [], [], []
    for j, fit in zip(columns, facets, strict=True):
        facet_light, jacobian = evaluate(fit.parameters, table.theta_rad)
        light.append(facet_light)
        variance.append(np.einsum("ij,jk,ik->i", jacobian, fit.covariance, jacobian))
        unlit = (facet_light < _DARK) & np.isfinite(table.response[:, j])
        shown = table.response[unlit, j] / fit.scale
        background.append(float(np.median(shown)) if len(shown) else 0.0)
        off = np.abs(shown - background[-1]) / table.faintness[unlit]
        dark.append(float(np.quantile(off, 0.8)) / _SIGMA_80 if len(shown) else 0.0)
    return _Witnesses(
        columns,
        np.array([fit.scale for fit in facets]),
        np.maximum(background, 0.0),
        np.array(dark),
        np.stack(light, axis=1),
        np.stack(variance, axis=1),
    )


def _loss(
    response: Array,
    witnesses: _Witnesses,
    light: Array,
    noise: NoiseModel,
    model_variance: Array | float,
    faintness: Array | float,
) -> Array:
    """Loss of each response (last axis: facets) given the light of each facet; not measured ones lose nothing."""
    measured = response / witnesses.scale
    expected = light + witnesses.background
    variance = y_slope(expected) ** 2 * (
        noise.variance(light, faintness) + (witnesses.dark * faintness) ** 2 + model_variance
    )
    loss = student_loss(to_y(np.nan_to_num(measured)) - to_y(expected), variance)
    shared: Array = np.where(np.isfinite(measured), loss, 0.0)
    return shared


def _grid(theta_rad: Array, step_rad: float) -> Array:
    """Directions, shape (n, 2), that cover all recorded ones, one typical width apart."""
    lowest, highest = theta_rad.min(axis=0), theta_rad.max(axis=0)
    step = max(step_rad, float(np.sqrt(np.prod(highest - lowest) / _MAX_GRID)))
    x, y = (np.arange(lowest[k], highest[k] + step, step) for k in (0, 1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _judge(
    table: ResponseTable,
    i: int,
    witnesses: _Witnesses,
    loss_here: Array,
    grid: Array,
    light_on_grid: Array,
    noise: NoiseModel,
    size_rad: float,
) -> BadRecord | None:
    response, faint = table.response[i, witnesses.columns], float(table.faintness[i])
    here = float(loss_here.sum())
    light = witnesses.light_at_records[i]
    factors = np.exp(_LOG_FACTORS)[:, None]

    variance = witnesses.model_variance[i]
    scaled = _loss(response, witnesses, factors * light, noise, factors**2 * variance, faint).sum(axis=1)
    glare = np.geomspace(0.05, 3.0, 10)[:, None] * np.median(witnesses.scale) / witnesses.scale
    added = _loss(response, witnesses, light + glare, noise, 0.0, faint).sum(axis=1)
    elsewhere = np.stack(
        [
            _loss(response, witnesses, lit, noise, (_RELATIVE * lit) ** 2, faint).sum(axis=1)
            for lit in factors[:, None] * light_on_grid
        ]
    )
    k_grid = int(np.argmin(elsewhere.min(axis=0)))
    # a factor needs facets that should be lit, and a glare must be worth the name
    can_scale = np.count_nonzero(light > _LIT) >= _MIN_LIT
    stories = {
        "cloud_edge": -np.inf if not can_scale else here - float(scaled.min()) - _PRICE_PER_NUMBER,
        "stray_light": here - float(added.min()) - _PRICE_PER_NUMBER,
        "wrong_star": here - float(elsewhere.min()) - 3.0 * _PRICE_PER_NUMBER,
    }
    kind = max(stories, key=lambda name: stories[name])
    if stories[kind] < _EVIDENCE:
        return None
    seen = rad_to_deg(table.theta_rad[i])
    place = f"star recorded at ({seen[0]:+.3f}, {seen[1]:+.3f}) deg"
    if kind == "wrong_star":
        shift = float(np.linalg.norm(grid[k_grid] - table.theta_rad[i]))
        if shift < _MIN_SHIFT_SIZES * size_rad:
            return None
        other = rad_to_deg(grid[k_grid])
        detail = f"{place}, but the facets that light up belong to ({other[0]:+.2f}, {other[1]:+.2f}) deg"
    elif kind == "cloud_edge":
        factor = float(factors[int(np.argmin(scaled)), 0])
        if max(factor, 1.0 / factor) < _MIN_FACTOR:
            return None
        detail = f"{place}, all facets {factor:.2g} times as bright as in the other records"
    else:
        detail = f"{place}, light on all facets that no star puts there"
    hurt = np.argsort(-loss_here)[:6]
    ids = tuple(table.facet_ids[witnesses.columns[k]] for k in hurt if loss_here[k] > 2.0)
    return BadRecord(int(table.record_index[i]), kind, detail, ids)
