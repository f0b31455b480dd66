"""What a lamp of unknown levels tells of a camera: how its response grows with the exposure, and no more."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from namod_ctl.calibration.lamp.lamp_visits import Visits
from namod_ctl.calibration.lamp.radiometric_fit import TWO_SIGMA
from namod_ctl.core.errors import DataQualityError

MIN_VISITS = 4
MIN_EXPOSURE_RATIO = 3.0


@dataclass(frozen=True, slots=True)
class ExposureRatio:
    """r_expo / r_resp: minus the power of the exposure with which the response grows; with its standard error."""

    value: float
    uncertainty: float
    n_visits: int
    n_placements: int


def exposure_ratio(visits: Visits) -> ExposureRatio:
    """r_expo / r_resp from exposures at one or more unknown levels of the lamp.

    Raises
    ------
    DataQualityError
        Too few exposures are neither saturated nor dark, or they are alike.
    """
    used = visits.is_usable
    placements = np.unique(visits.placement[used])
    n, n_unknown = int(used.sum()), len(placements) + 1
    if n < max(MIN_VISITS, n_unknown + 2) or np.ptp(visits.log_exposure[used]) < math.log10(MIN_EXPOSURE_RATIO):
        raise DataQualityError(
            f"{n} exposures at {len(placements)} level(s) are neither saturated nor too dark: too few, or too much "
            "alike; take exposures from short to long"
        )
    levels = (visits.placement[used][:, None] == placements).astype(np.float64)
    design = np.hstack([visits.log_exposure[used][:, None], levels])
    found, *_ = np.linalg.lstsq(design, visits.log_share[used], rcond=None)
    residual = visits.log_share[used] - design @ found
    freedom = n - n_unknown
    variance = float(residual @ residual) / freedom * np.linalg.inv(design.T @ design)[0, 0]
    widened = float(stdtrit(freedom, TWO_SIGMA)) / 2.0
    return ExposureRatio(-float(found[0]), widened * float(variance) ** 0.5, n, len(placements))
