"""The picture of a radiometric calibration: responses against exposures, and how far they are from the law."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION, colours
from namod_ctl.calibration.lamp.radiometric_verdict import RadiometricFinding

Array = NDArray[np.float64]

PERCENT = 100.0
_LIMIT_PERCENT = 1.0
_LEFT_OUT = "#9a9a9a"
_TICKS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)


def draw_radiometric(finding: RadiometricFinding, camera: str) -> Figure:
    """Responses with the law's lines, residuals over response and exposure, and errors of the lamp's placements."""
    figure = Figure(figsize=(11.5, 8.8), dpi=DPI, facecolor="white")
    top, bottom = (0.08, 0.53, 0.39, 0.34), (0.08, 0.075, 0.39, 0.34)
    right = 0.505
    _draw_responses(figure.add_axes(top), finding)
    _draw_placements(figure.add_axes((top[0] + right, *top[1:])), finding)
    used = finding.is_used
    residual = np.expm1(finding.fit.residual_dex * math.log(10.0)) * PERCENT
    over_response = figure.add_axes(bottom)
    _draw_residual(over_response, 10.0 ** finding.visits.log_share[used], residual, finding.visits.placement[used])
    for one in finding.bins:
        over_response.errorbar(
            one.response_share, one.departure_share * PERCENT, one.error_share * PERCENT, fmt="s", color=VERMILLION,
            ms=5, capsize=3, zorder=4, label="mean of a range" if one is finding.bins[0] else None,
        )  # fmt: skip
    for share in finding.usable_response_share:
        over_response.axvline(share, color=ORANGE, ls="--", lw=1.5)
    over_response.set_xlabel("response, share of full scale (dashed: usable range)")
    over_response.legend(loc="lower right", fontsize=8, framealpha=0.9)
    over_exposure = figure.add_axes((bottom[0] + right, *bottom[1:]))
    _draw_residual(over_exposure, 10.0 ** finding.visits.log_exposure[used], residual, finding.visits.placement[used])
    over_exposure.set_xlabel("exposure [s]")
    figure.text(0.03, 0.97, f"{camera}: {_law_words(finding)}", fontsize=12, va="center")
    figure.text(0.03, 0.937, _quality_words(finding), fontsize=9.5, va="center")
    return figure


def _law_words(finding: RadiometricFinding) -> str:
    values, errors = finding.fit.parameters, np.sqrt(np.diag(finding.fit.covariance))
    names = ["r_resp", "r_expo", "r_const"] + (["r_curve"] if finding.law_name == "curved" else [])
    return ",  ".join(f"{name} = {values[i]:.4f} ± {errors[i]:.4f}" for i, name in enumerate(names))


def _quality_words(finding: RadiometricFinding) -> str:
    n_placements = len(finding.fit.placement_error_dex)
    return (
        f"{finding.verdict}; {int(finding.is_used.sum())} of {finding.visits.n} exposures at {n_placements} placements "
        f"of the lamp; residuals {finding.residual_rms_share:.2%} rms; intensities known within "
        f"{finding.intensity_error_share:.2%}"
    )


def _draw_responses(axes: Axes, finding: RadiometricFinding) -> None:
    """Response against exposure with a line of the law for each level."""
    visits = finding.visits
    levels = np.unique(visits.log_level)
    steps = np.linspace(visits.log_exposure.min(), visits.log_exposure.max(), 200)
    for level in levels:
        axes.plot(10.0**steps, 10.0 ** _log_share(finding, level, steps), color=_colour(level, levels), lw=1.0)
    used, share = finding.is_used, 10.0**visits.log_share
    exposure_s = 10.0**visits.log_exposure
    left_out = ~used
    axes.scatter(
        exposure_s[used], share[used], s=16, c=[_colour(level, levels) for level in visits.log_level[used]], zorder=3,
    )  # fmt: skip
    axes.plot(exposure_s[left_out], share[left_out], "x", color=_LEFT_OUT, ms=6, zorder=3, label="not used")
    axes.axhline(finding.saturation_share, color=ORANGE, ls="--", lw=1.5, label="saturated from here")
    _logarithmic(axes, "x")
    _logarithmic(axes, "y")
    axes.set_ylim(min(float(share.min()) * 0.7, 0.01), 1.5)
    axes.set_xlabel("exposure [s]")
    axes.set_ylabel("response, share of full scale")
    axes.set_title(f"{len(levels)} levels of the lamp, and the law as lines", fontsize=10)
    axes.legend(loc="lower right", fontsize=8, framealpha=0.9)


def _log_share(finding: RadiometricFinding, log_level: float, log_exposure: Array) -> Array:
    """log10 of the response that the law expects."""
    r_resp, r_expo, r_const, r_curve = finding.fit.parameters
    light = log_level - r_expo * log_exposure - r_const
    root = np.sqrt(np.maximum(r_resp**2 + 4.0 * r_curve * light, 1e-9))
    share: Array = 2.0 * light / (r_resp + root)
    return share


def _colour(level: float, levels: Array) -> tuple[float, ...]:
    span = float(np.ptp(levels)) or 1.0
    shade = colours()(0.9 * (level - levels[0]) / span)
    return tuple(float(part) for part in shade)


def _draw_placements(axes: Axes, finding: RadiometricFinding) -> None:
    """How far the light of each placement is from its nominal level, in the order of time."""
    numbers = np.unique(finding.visits.placement[finding.is_used])
    error = np.expm1(finding.fit.placement_error_dex * math.log(10.0)) * PERCENT
    scatter = math.expm1(finding.fit.placement_dex * math.log(10.0)) * PERCENT
    axes.axhspan(-scatter, scatter, color=SKY, alpha=0.3, lw=0, label="their scatter, by the fit")
    axes.axhline(0.0, color="black", lw=0.8)
    axes.plot(np.arange(len(numbers)), error, "o", color="black", ms=6)
    axes.set_xticks(np.arange(len(numbers)), [finding.placements[number].words for number in numbers], rotation=60)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_ylabel("light against the nominal level [%]")
    drift = "drift of the lamp could not be told"
    if math.isfinite(finding.drift_share):
        drift = f"drift of the lamp {finding.drift_share:+.2%} ± {finding.drift_error_share:.2%}, taken off"
    axes.set_title(f"placements of the lamp in the order of time\n{drift}", fontsize=10)
    reach = 1.5 * max(float(np.abs(error).max()), scatter, 0.2)
    axes.set_ylim(-reach, reach)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _draw_residual(axes: Axes, x: Array, residual_percent: Array, placement: NDArray[np.intp]) -> None:
    shade = colours()(0.9 * placement / max(int(placement.max()), 1))
    axes.axhspan(-_LIMIT_PERCENT, _LIMIT_PERCENT, color="#eeeeee", lw=0, zorder=0)
    axes.axhline(0.0, color="black", lw=0.8, zorder=1)
    axes.scatter(x, residual_percent, s=14, c=shade, zorder=2)
    reach = max(1.2 * float(np.abs(residual_percent).max()), 1.3 * _LIMIT_PERCENT)
    axes.set_ylim(-reach, reach)
    _logarithmic(axes, "x")
    axes.set_ylabel("intensity by the law, residual [%]")


def _logarithmic(axes: Axes, which: str) -> None:
    """A logarithmic axis with ticks in plain numbers."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis.set_major_locator(FixedLocator(_TICKS))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(lambda _value, _: ""))
