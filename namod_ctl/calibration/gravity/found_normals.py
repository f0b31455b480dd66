"""The facets' orientations that put their light where it was found.

To first order a facet is brightest at twice its tilt. Its light is not symmetric, though: a spherical facet far from
the axis throws a comatic image whose centre of gravity lies beside the ray of the facet's centre, on FACT by 0.4
arcmin. Corrections need not care, they repeat; a file of orientations does, or the image traced from it is another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.coordinates import correction_of_theta
from namod_ctl.optics.raytrace import combine_moments, facet_moments, trace
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

N_RAYS = 300
N_STEPS = 30
NEAR_SHARE = 1e-9
"""Of the focal length: 5 nm on FACT, less than what is written to files."""


def tilts_of_theta(reflector: Reflector, theta_rad: Array) -> Array:
    """Tilt of every facet that has its light's centre of gravity on the focal point for a star at `theta_rad`.

    Both of shape (n_facets, 2), telescope frame; NaN where `theta_rad` is NaN.

    Raises
    ------
    DataQualityError
        No such tilt can be found: the direction is far outside of what the facet can see.
    """
    tilts = -correction_of_theta(theta_rad)
    known = np.flatnonzero(np.isfinite(theta_rad).all(axis=1))
    for j in known:
        facet = reflector.facets[j]
        alone = reflector.subset([facet.id])
        distance_m = float(np.linalg.norm(np.array([0.0, 0.0, reflector.focal_length_m]) - facet.position_m))
        for _ in range(N_STEPS):
            miss_m = combine_moments(facet_moments(trace(alone, N_RAYS, theta_rad[j], tilts[j : j + 1]))).mean_m
            tilts[j] -= miss_m / (2.0 * distance_m)  # reflection doubles angles; obliquity is left to the next step
            if np.linalg.norm(miss_m) < NEAR_SHARE * reflector.focal_length_m:
                break
        else:
            raise DataQualityError(
                f"facet {facet.id}: no orientation throws a star at theta = ({theta_rad[j, 0]:.4f}, "
                f"{theta_rad[j, 1]:.4f}) rad on the focal point; check the run and its telescope"
            )
    return tilts
