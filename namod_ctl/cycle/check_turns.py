"""Whether people turned what they were asked for, facet by facet, from the orientations before and after."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment


def check_last_turns(
    mounts: Mapping[int, Mount],
    asked_deg: Mapping[int, NDArray[np.float64]],
    before: Alignment,
    after: Alignment,
    goniometer_sigma_rad: float,
) -> list[str]:
    """One sentence per facet that was asked for or has moved."""
    return []
