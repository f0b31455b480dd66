"""A look-up table over zenith distance as a person reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from namod_ctl.app.lut.files import Lut
from namod_ctl.core.units import deg_to_rad, rad2_to_arcmin2, rad_to_arcmin, rad_to_deg

Array = NDArray[np.float64]

MOST_ROWS = 60
_TERM_WORDS = {"sin": "sin z", "cos": "cos z - 1"}


def terms_in_words(terms: Sequence[str]) -> str:
    """Such as "constant + sin z"."""
    return " + ".join(["constant", *(_TERM_WORDS[term] for term in terms)])


def runs_table(lut: Lut) -> Table:
    """Where the runs were, and what the whole image did between them."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, title="Runs", title_justify="left")
    for column in ("run", "zenith / deg", "came from", "whole image moved x, y / arcmin"):
        table.add_column(column, justify="left" if column in ("run", "came from") else "right")
    for run in lut.runs:
        common, sigma = (rad_to_arcmin(deg_to_rad(np.array(v))) for v in (run.common_deg, run.common_uncertainty_deg))
        table.add_row(
            run.name,
            f"{run.zenith_deg:.1f} ({run.zenith_first_deg:.1f} to {run.zenith_last_deg:.1f})",
            run.came_from,
            f"{common[0]:+.2f}, {common[1]:+.2f} ± {sigma.max():.2f}",
        )
    return table


def facets_table(lut: Lut) -> Table:
    """Every facet's terms with their errors; of many facets those that move most."""
    table = lut.table
    size = np.nan_to_num(np.linalg.norm(table.beta_rad[:, 1:], axis=-1).sum(axis=-1))
    chosen = sorted(np.argsort(-size, kind="stable")[:MOST_ROWS])
    more = "" if len(chosen) == len(size) else f", the {MOST_ROWS} of {len(size)} that move most"
    shown = Table(
        box=SIMPLE_HEAD, pad_edge=False, title=f"Theta relative to the mean of all facets, arcmin{more}",
        title_justify="left",
    )  # fmt: skip
    shown.add_column("facet", justify="right")
    for term in table.terms:
        shown.add_column(f"{_TERM_WORDS[term]}: x, y ±", justify="right")
    shown.add_column("chance", justify="right")
    shown.add_column("used")
    for j in chosen:
        cells = [str(table.facet_ids[j])]
        for i in range(1, 1 + len(table.terms)):
            x, y = table.beta_rad[j, i]
            sigma = math.sqrt(np.trace(table.cov_rad2[j, i, :, i, :]) / 2.0)
            cells.append(f"{_arcmin(x)}, {_arcmin(y)} ± {_plain_arcmin(sigma)}")
        chance = lut.chance[j]
        is_moving = bool(table.is_moving[j])
        shown.add_row(
            *cells, "-" if math.isnan(chance) else f"{chance:.1g}",
            Text("yes" if is_moving else "no", style="" if is_moving else "yellow"),
        )  # fmt: skip
    return shown


def areas_table(
    zenith_rad: Array, columns: Sequence[tuple[str, Array]], limit_rad2: float, uncertainty_rad2: Array | None = None
) -> Table:
    """A_sigma over zenith distances; the last column's uncertainty is `uncertainty_rad2` (n,)."""
    table = Table(
        box=SIMPLE_HEAD, pad_edge=False, title_justify="left",
        title=f"A_sigma / arcmin2 and times the limit of {rad2_to_arcmin2(limit_rad2):.2f}",
    )  # fmt: skip
    table.add_column("zenith / deg", justify="right")
    for name, _ in columns:
        table.add_column(name, justify="right")
    for i, zenith in enumerate(zenith_rad):
        cells = [f"{rad2_to_arcmin2(area[i]):.2f}  {area[i] / limit_rad2:.3f}" for _, area in columns]
        if uncertainty_rad2 is not None:
            cells[-1] += f" ± {uncertainty_rad2[i] / limit_rad2:.3f}"
        table.add_row(f"{rad_to_deg(float(zenith)):.0f}", *cells)
    return table


def tilts_table(lut: Lut, from_rad: float, to_rad: float) -> Table:
    """By how much Theta of every facet changes between two zenith distances, and with which error."""
    change = lut.table.change_rad(from_rad, to_rad)
    cov = lut.table.change_cov_rad2(from_rad, to_rad)
    chosen = sorted(np.argsort(-np.linalg.norm(change, axis=-1), kind="stable")[:MOST_ROWS])
    table = Table(
        box=SIMPLE_HEAD, pad_edge=False, title_justify="left",
        title=f"Theta changes from {rad_to_deg(from_rad):g} to {rad_to_deg(to_rad):g} deg, arcmin; the table turns "
        "facets by minus half of it",
    )  # fmt: skip
    for column in ("facet", "x", "y", "± x", "± y"):
        table.add_column(column, justify="right")
    for j in chosen:
        sigma = np.sqrt(np.diag(cov[j]))
        table.add_row(str(lut.table.facet_ids[j]), *map(_arcmin, change[j]), *map(_plain_arcmin, sigma))
    return table


def hysteresis_in_words(lut: Lut) -> str:
    """One line."""
    found = lut.hysteresis
    if found is None:
        return "Hysteresis: not measured."
    difference, sigma = (
        rad_to_arcmin(deg_to_rad(value))
        for value in (found.difference_at_45_deg, found.difference_at_45_deg_uncertainty)
    )
    play = f"the facets follow after {found.play_deg:.1f} ± {found.play_uncertainty_deg:.1f} deg of turning back"
    at_45 = f"{difference:.3f} ± {sigma:.3f} arcmin (rms) between both sides at 45 deg"
    verdict = "" if found.is_significant else "not significant: "
    return f"Hysteresis: {verdict}{play}; {at_45}."


def fit_in_words(lut: Lut) -> list[str]:
    """Verdict, model and remarks, a line each."""
    table = lut.table
    n_moving = int(table.is_moving.sum())
    lines = [
        f"{table.telescope}: {'good' if lut.is_good else 'LIMITED'} table of {lut.made_utc} from {len(lut.runs)} runs, "
        f"{terms_in_words(table.terms)}; {n_moving} of {len(table.facet_ids)} facets move.",
        "Terms tried (less is better): "
        + "; ".join(
            f"{terms_in_words(test.terms)} {test.bic:.0f}"
            + ("" if math.isnan(test.chance) else f" (chance {test.chance:.1g})")
            for test in lut.tests
        )
        + ".",
        f"About the model runs scatter by {rad_to_arcmin(lut.residual_rms_rad):.3f} arcmin (rms per axis), "
        f"{lut.scatter:.2f} of their stated errors.",
        hysteresis_in_words(lut),
        common_in_words(lut),
    ]
    odd = zip(table.facet_ids, lut.facet_remarks, strict=True)
    lines += [f"Facet {facet_id} is left out: {remark}." for facet_id, remark in odd if remark]
    return lines + [f"Note: {remark}." for remark in lut.remarks]


def common_in_words(lut: Lut) -> str:
    """One line on the motion of the whole image."""
    common = deg_to_rad(np.array([run.common_deg for run in lut.runs]))
    reach = rad_to_arcmin(float(np.max(np.linalg.norm(common[:, None] - common[None], axis=-1))))
    return (
        f"The whole image moved by up to {reach:.2f} arcmin between the runs: the structure bent, or the star camera. "
        "It spreads no light, belongs into the pointing model and is not in this table."
    )


def _arcmin(angle_rad: float) -> str:
    return "-" if math.isnan(angle_rad) else f"{rad_to_arcmin(float(angle_rad)):+.3f}"


def _plain_arcmin(angle_rad: float) -> str:
    return "-" if math.isnan(angle_rad) else f"{rad_to_arcmin(float(angle_rad)):.3f}"
