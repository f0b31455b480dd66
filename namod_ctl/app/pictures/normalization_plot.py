"""The responses of facets against the star's brightness: as recorded, and with the slope taken out.

After the figure of arXiv:1605.06274, section 3, which showed FACT's slope of -6.9 % per magnitude.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, SKY, VERMILLION
from namod_ctl.reconstruction.normalization import PER_MAGNITUDE, Normalization, slope_in_words

NORMALIZATION_PLOT_FILE = "normalization.png"

_GREY = "#8a8a8a"
_N_BINS = 10
_MIN_IN_BIN = 3
_SHOWN_QUANTILE = 0.005
_MAX_ERROR = 0.3  # of a record's factor: those that tell less would only hide the others


def draw_normalization(normalization: Normalization, telescope: str) -> Figure:
    """Two panels above each other; of a normalization that is known."""
    n = normalization
    figure = Figure(figsize=(8.0, 7.4), dpi=DPI, facecolor="white")
    above, below = figure.subplots(2, 1, sharex=True, sharey=True)
    figure.subplots_adjust(left=0.11, right=0.97, top=0.83, bottom=0.08, hspace=0.24)
    trend = PER_MAGNITUDE * n.exponent * n.magnitude
    _panel(above, n, np.exp(n.log_factor), "As recorded")
    line = np.linspace(n.steady_magnitude.min(), n.steady_magnitude.max(), 100)
    law, sigma = np.exp(PER_MAGNITUDE * n.exponent * line), np.abs(PER_MAGNITUDE * line) * n.exponent_uncertainty
    above.plot(line, law, color=VERMILLION, label="fitted slope, with one standard deviation")
    above.fill_between(line, law * np.exp(-sigma), law * np.exp(sigma), color=VERMILLION, alpha=0.25, linewidth=0.0)
    _panel(below, n, np.exp(n.log_factor - trend), "Without the slope, as a self-calibration leaves it")
    below.set_xlabel("brightness of the star beside the run's typical one / mag (fainter to the right)")
    told = n.log_factor_uncertainty < _MAX_ERROR
    shown = np.quantile(np.exp(n.log_factor[told]), [_SHOWN_QUANTILE, 1.0 - _SHOWN_QUANTILE])
    margin = 0.15 * float(np.ptp(shown))
    above.set_ylim(max(shown[0] - margin, 0.0), shown[1] + margin)
    above.legend(loc="best", fontsize="small", framealpha=0.9)
    top = above.secondary_xaxis("top", functions=(_intensity_of, _magnitude_of))
    top.set_xlabel("intensity of the star / that of the typical record")
    ticks = [tick for tick in (0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if _is_within(tick, n.steady_magnitude)]
    top.set_xticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    figure.suptitle(
        f"{telescope}: response of {n.n_facets} facets in {len(n.magnitude)} records\n{slope_in_words(n)}",
        fontsize=11.5,
    )
    return figure


def _panel(axes: Axes, n: Normalization, factor: NDArray[np.float64], title: str) -> None:
    """The common factor of each record, and their medians over magnitudes.

    Over the magnitude that the neighbouring records tell: the noise of a record's own star intensity divides its
    responses, too, and would bend the ends of the curve.
    """
    axes.axhline(1.0, color="black", linewidth=0.8, linestyle="--")
    told = n.log_factor_uncertainty < _MAX_ERROR
    axes.plot(
        n.steady_magnitude[told],
        factor[told],
        ".",
        color=_GREY,
        markersize=3.5,
        alpha=0.7,
        label="facets lit in one record",
    )
    edges = np.quantile(n.steady_magnitude, np.linspace(0.0, 1.0, _N_BINS + 1))
    bin_of = np.clip(np.searchsorted(edges, n.steady_magnitude, side="right") - 1, 0, _N_BINS - 1)
    found = []
    for k in range(_N_BINS):
        inside = np.flatnonzero((bin_of == k) & told)
        if len(inside) < _MIN_IN_BIN:
            continue
        median = float(np.median(factor[inside]))
        error = 1.4826 * float(np.median(np.abs(factor[inside] - median))) * np.sqrt(np.pi / 2.0 / len(inside))
        found.append((float(np.mean(n.steady_magnitude[inside])), median, error))
    if found:
        x, y, error = np.array(found).T
        axes.errorbar(x, y, error, fmt="o", color="#0072b2", mfc=SKY, markersize=5.5, capsize=2.5, label="their median")
    axes.set_title(title, fontsize="medium", loc="left")
    axes.set_ylabel("response / typical response")


def _intensity_of(magnitude: NDArray[np.float64]) -> NDArray[np.float64]:
    intensity: NDArray[np.float64] = np.exp(PER_MAGNITUDE * magnitude)
    return intensity


def _magnitude_of(intensity: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(divide="ignore", invalid="ignore"):
        magnitude: NDArray[np.float64] = np.log(intensity) / PER_MAGNITUDE
    return magnitude


def _is_within(intensity: float, magnitude: NDArray[np.float64]) -> bool:
    return bool(magnitude.min() <= np.log(intensity) / PER_MAGNITUDE <= magnitude.max())
