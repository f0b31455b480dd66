"""What the page shows of the facets: where they are, how far each is off, and what light they make together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.twin import instrument_on_twin
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.dashboard.numbers import short, shorts
from namod_ctl.core.flags import FACET_FLAG_MEANING
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment

Array = NDArray[np.float64]

N_PSF_CELLS = 45
"""Along the side of the pictures of the whole reflector's point spread function."""

_REACH_SIGMAS = 3.0


def instrument_of(config: InstrumentConfig) -> Instrument:
    """The instrument, with outlines of its facets in the picture even where nobody has drawn any."""
    return instrument_on_twin(config)


def geometry(instrument: Instrument) -> dict[str, Any]:
    """Outlines of the facets in the reflector camera's picture, and how its and the star camera's pixels lie."""
    polygons = instrument.facet_polygons_px
    return {
        "telescope": instrument.name,
        "reflector_camera": _size(instrument.reflector_camera),
        "star_camera": _size(instrument.star_camera) | {"star_px": _star_px(instrument)},
        "facets": [
            {
                "id": facet_id,
                "corners": [[round(float(x), 1), round(float(y), 1)] for x, y in polygons[facet_id]],
                "centre": [round(float(value), 1) for value in np.mean(polygons[facet_id], axis=0)],
            }
            for facet_id in instrument.reflector.ids
            if facet_id in polygons
        ],
    }


def facet_table(alignment: Alignment, history: Mapping[int, Alignment]) -> list[dict[str, Any]]:
    """One entry per facet; `history` holds the alignments of a campaign's cycles, for the way it came."""
    before = {cycle: {facet.facet_id: facet for facet in each.facets} for cycle, each in history.items()}
    return [
        {
            "id": facet.facet_id,
            "off_arcmin": short(rad_to_arcmin(misalignment_rad(facet, alignment.axis_rad))),
            "off_uncertainty_arcmin": short(rad_to_arcmin(_uncertainty_rad(facet) / 2.0)),
            "theta_arcmin": shorts(rad_to_arcmin(facet.theta_rad)),
            "ellipse_arcmin": _ellipse(facet.theta_cov_rad2),
            "width_arcmin": shorts(rad_to_arcmin(np.array([facet.width_major_rad, facet.width_minor_rad]))),
            "n_records": facet.n_records_in_psf,
            "flags": [
                {"name": flag.name, "meaning": FACET_FLAG_MEANING[flag]}
                for flag in FACET_FLAG_MEANING
                if flag & facet.flags
            ],
            "is_refused": facet.flags.forbids_turning,
            "remarks": list(facet.remarks),
            "history": [
                [cycle, short(rad_to_arcmin(misalignment_rad(facets[facet.facet_id], history[cycle].axis_rad)))]
                for cycle, facets in before.items()
                if facet.facet_id in facets
            ],
        }
        for facet in alignment.facets
    ]


def rough_table(instrument: Instrument, centres_rad: Mapping[int, Array]) -> list[dict[str, Any]]:
    """The entries of `facet_table` while there is no estimate, from rough centres of light, shape (2,), by facet id."""
    if instrument.star_camera.axis_is_calibrated or not centres_rad:
        axis = np.zeros(2)
    else:  # what corrections aim at then
        axis = np.median(list(centres_rad.values()), axis=0)
    unknown = np.full(2, math.nan)
    return [
        {
            "id": facet_id,
            "off_arcmin": short(rad_to_arcmin(float(np.hypot(*(theta - axis))) / 2.0)),
            "off_uncertainty_arcmin": None,
            "theta_arcmin": shorts(rad_to_arcmin(theta)),
            "ellipse_arcmin": None,
            "width_arcmin": [None, None],
            "n_records": None,
            "flags": [],
            "is_refused": False,
            "remarks": [],
            "history": [],
        }
        for facet_id in instrument.reflector.ids
        for theta in (centres_rad.get(facet_id, unknown),)
    ]


def misalignment_rad(facet: FacetAlignment, axis_rad: Array) -> float:
    """By how much the facet's normal is wrong: half the distance of its centre from the axis; NaN when not known."""
    return float(np.hypot(*(facet.theta_rad - axis_rad))) / 2.0


def whole_psf(alignment: Alignment, predicted_rad2: float, limit_rad2: float) -> dict[str, Any] | None:
    """Pictures of the light of all facets together now, and after the correction; None while no facet is known.

    Every facet's light is a round gaussian of its estimated size: what the alignment on the disk knows of its shape.
    The area now is that of the reconstruction, the others are given, NaN when not known. Cells run from -y to +y and
    from -x to +x; 255 is the brightest.
    """
    known = [facet for facet in alignment.facets if math.isfinite(facet.flux) and math.isfinite(facet.width_major_rad)]
    if not known:
        return None
    flux = np.array([max(facet.flux, 0.0) for facet in known])
    if flux.sum() <= 0.0:
        return None
    sigma = np.sqrt([max(facet.width_major_rad * facet.width_minor_rad, 1e-12) for facet in known])
    axis = alignment.axis_rad
    now = np.array([facet.theta_rad for facet in known])
    predicted = np.where([[facet.flags.forbids_turning] for facet in known], now, axis)
    centre = np.average(now, axis=0, weights=flux)
    offset = now - centre
    share = flux / flux.sum()
    cov = np.einsum("j,ja,jb->ab", share, offset, offset) + np.eye(2) * float(share @ sigma**2)
    reach = _REACH_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))
    reach = max(reach, float(np.abs(centre - axis).max()) + reach / 2.0)
    return {
        "axis_arcmin": shorts(rad_to_arcmin(axis)),
        "reach_arcmin": short(rad_to_arcmin(reach)),
        "now": _picture(now - axis, sigma, flux, reach),
        "predicted": _picture(predicted - axis, sigma, flux, reach),
        "centre_arcmin": shorts(rad_to_arcmin(centre - axis)),
        "ellipse_arcmin": _ellipse(_of_area(cov, alignment.now.a_sigma_rad2)),
        "area_now": _area(alignment.now.a_sigma_rad2),
        "area_now_uncertainty": _area(alignment.now.uncertainty_rad2),
        "area_predicted": _area(predicted_rad2),
        "area_limit": _area(limit_rad2),
    }


def _of_area(cov_rad2: Array, area_rad2: float) -> Array:
    """The covariance, scaled so that its one-sigma ellipse has that area."""
    own = math.pi * math.sqrt(max(float(np.linalg.det(cov_rad2)), 0.0))
    return cov_rad2 * (area_rad2 / own) if math.isfinite(area_rad2) and own > 0.0 else cov_rad2


def _picture(centre_rad: Array, sigma_rad: Array, flux: Array, reach_rad: float) -> list[list[int]]:
    middles = ((np.arange(N_PSF_CELLS) + 0.5) / N_PSF_CELLS * 2.0 - 1.0) * reach_rad
    along_x = np.exp(-0.5 * ((middles[None, :] - centre_rad[:, :1]) / sigma_rad[:, None]) ** 2)
    along_y = np.exp(-0.5 * ((middles[None, :] - centre_rad[:, 1:]) / sigma_rad[:, None]) ** 2)
    light = np.einsum("j,jr,jc->rc", flux / sigma_rad**2, along_y, along_x)
    cells: list[list[int]] = np.rint(255.0 * light / max(float(light.max()), 1e-300)).astype(int).tolist()
    return cells


def _ellipse(cov_rad2: Array) -> list[float] | None:
    """Half axes in arcmin and the direction of the larger one in degrees from +x to +y; None when not known."""
    if not np.isfinite(cov_rad2).all():
        return None
    variances, axes = np.linalg.eigh(cov_rad2)
    major, minor = np.sqrt(np.maximum(variances[::-1], 0.0))
    angle_deg = rad_to_deg(math.atan2(axes[1, 1], axes[0, 1]))
    return [round(float(rad_to_arcmin(major)), 4), round(float(rad_to_arcmin(minor)), 4), round(float(angle_deg), 1)]


def _uncertainty_rad(facet: FacetAlignment) -> float:
    cov = facet.theta_cov_rad2
    return math.sqrt(float(np.linalg.eigvalsh(cov)[-1])) if np.isfinite(cov).all() else math.nan


def _area(area_rad2: float) -> float | None:
    return short(rad2_to_arcmin2(area_rad2))


def _size(camera: CameraModel) -> dict[str, Any]:
    return {"columns": camera.n_columns, "rows": camera.n_rows}


def _star_px(instrument: Instrument) -> float:
    """Diameter of the star's image in pixels."""
    return round(instrument.star_size_rad / instrument.star_camera.plate_scale_rad, 1)
