"""A radiometric calibration as a table for people."""

from __future__ import annotations

import math

import numpy as np
from rich.table import Table

from namod_ctl.calibration.lamp.radiometric_verdict import RadiometricFinding


def radiometric_table(finding: RadiometricFinding, by_config: tuple[float, float, float]) -> Table:
    """The law beside that of the config (r_resp, r_expo, r_const), and what it is good for."""
    table = Table(title=f"log I = r_resp log C + r_expo log T + r_const ({finding.law_name.replace('_', ' ')})")
    for name in ("", "found", "uncertainty", "config"):
        table.add_column(name, justify="left" if not name else "right")
    errors = np.sqrt(np.diag(finding.fit.covariance))
    names = ("r_resp", "r_expo", "r_const") + (("r_curve",) if finding.law_name == "curved" else ())
    for i, name in enumerate(names):
        config = f"{by_config[i]:.4f}" if i < len(by_config) else "0"
        table.add_row(name, f"{finding.fit.parameters[i]:.4f}", f"{errors[i]:.4f}", config)
    table.add_section()
    low, high = finding.usable_response_share
    seen = "" if finding.is_saturation_seen else ", not seen"
    drift = "cannot be told"
    if math.isfinite(finding.drift_share):
        drift = f"{finding.drift_share:+.2%} ({finding.drift_error_share:.2%})"
    departure = max((abs(one.departure_share) for one in finding.bins), default=0.0)
    rows = {
        "usable response": f"{low:.1%} to {high:.1%} of full scale",
        "usable exposure": f"{finding.usable_exposure_s[0]:.3g} to {finding.usable_exposure_s[1]:.3g} s",
        "saturated from": f"{finding.saturation_share:.1%}{seen}",
        "departs from the law": f"{departure:.2%} at most, {finding.residual_rms_share:.2%} rms",
        "intensities known within": f"{finding.intensity_error_share:.2%}",
        "lamp: flicker, drift": f"{finding.visits.flicker_share:.2%}, {drift}",
        "lamp: errors of levels": f"{math.expm1(finding.fit.placement_dex * math.log(10.0)):.2%}",
    }
    for name, words in rows.items():
        table.add_row(name, words, "", "")
    return table
