"""Import of response maps: a folder of CSV files becomes a run.

The maps hold R = m / s only, so the run's records get s = 1 and m = R; saturation and exposures are unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from namod_ctl.core.clock import Clock
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad_to_deg
from namod_ctl.store.folders import check_output, discard, free_sibling, put_in_place
from namod_ctl.store.response_maps import ResponseMaps, pixel_grid_step_rad, read_response_maps
from namod_ctl.store.run import RunStore
from namod_ctl.store.summary import ImportSummary, summarize_import


def import_maps(
    folder: Path,
    out: Path,
    *,
    config_facet_ids: Sequence[int],
    plate_scale_rad: float,
    config_json: str,
    clock: Clock,
    force: bool = False,
) -> ImportSummary:
    """Summary of the new run at `out`, made of all response maps in `folder`; on any error nothing is written.

    Parameters
    ----------
    config_facet_ids
        Facets of the config, in its order.
    plate_scale_rad
        Of the star camera, to recognise directions that are whole pixels.

    Raises
    ------
    ConfigError
        The maps are wrong (see `read_response_maps`) or `out` may not be written.
    StoreError
        The disk refuses.
    """
    check_output(out, force=force)
    maps = read_response_maps(folder, config_facet_ids)
    step_rad = pixel_grid_step_rad(maps.theta_rad, plate_scale_rad)
    records = maps_to_records(maps, math.nan if step_rad is None else step_rad / math.sqrt(12.0))
    out = out.resolve()
    built = free_sibling(out)
    source = f"response maps of {folder.resolve()}"
    try:
        with RunStore.create(built, maps.facet_ids, config_json, source, clock) as run:
            run.append(records)
        put_in_place(built, out, force=force)
    except BaseException:
        discard(built)
        raise
    if step_rad is None:
        remark = "The directions lie on no grid of pixels: their uncertainty is unknown."
    else:
        remark = (
            f"The directions are whole pixels of {rad_to_deg(step_rad):.7f} deg (the config's star camera: "
            f"{rad_to_deg(plate_scale_rad):.7f} deg): uncertainty 1/sqrt(12) pixel."
        )
    return summarize_import(records, maps.facet_ids, config_facet_ids, [remark])


def maps_to_records(maps: ResponseMaps, theta_uncertainty_rad: float) -> list[Record]:
    """One record per row of the maps, all accepted: s = 1, m = R; labels name the line in the files."""
    unknown = np.full(len(maps.facet_ids), np.nan)
    return [
        Record(
            index=row,
            label=f"line {row + 2}",
            theta_rad=theta,
            theta_uncertainty_rad=theta_uncertainty_rad,
            star_intensity=1.0,
            facet_intensity=response,
            facet_saturated_share=unknown,
            star_exposure_s=math.nan,
            reflector_exposure_s=math.nan,
        )
        for row, (theta, response) in enumerate(zip(maps.theta_rad, maps.response, strict=True))
    ]
