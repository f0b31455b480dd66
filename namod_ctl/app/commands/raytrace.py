"""`namod-ctl raytrace`: the point spread function of a perfectly aligned reflector, the limit of every alignment."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import arcsec_to_rad, deg_to_rad, m_to_mm, rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.optics.raytrace import (
    RayTrace,
    a_sigma_rad2,
    combine_moments,
    containment_radius_m,
    facet_moments,
    trace,
    with_common_focal_length,
)
from namod_ctl.optics.reflector import Reflector

_SAMPLING_ERROR_WORTH_A_WORD = 0.005


@dataclass(frozen=True, slots=True)
class _Limit:
    """The traced point spread function in the units people read."""

    a_sigma_arcmin2: float
    relative_sampling_error: float
    r80_mm: float
    r80_arcmin: float
    centroid_x_mm: float
    centroid_y_mm: float


def raytrace(
    config: Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or the name of a built-in one.")],
    rays_per_facet: Annotated[int, typer.Option(min=20, max=100_000, help="Rays traced on each facet.")] = 2000,
    theta_x_deg: Annotated[float, typer.Option(min=-45, max=45, help="The star's distance from the axis in x.")] = 0.0,
    theta_y_deg: Annotated[float, typer.Option(min=-45, max=45, help="The star's distance from the axis in y.")] = 0.0,
    roughness_arcsec: Annotated[
        float, typer.Option(min=0, max=3600, help="Slope error of the surface, standard deviation per axis.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the slope errors.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Trace the reflector with every facet perfectly aligned: A_sigma, centroid and r80.

    Once with every facet given the telescope's focal length, once with the facets' own. r80 is the radius about
    the centroid that holds 80 % of the light. Shadowing is not modelled.

    Example: namod-ctl raytrace --config config/fact.toml
    """
    instrument = build_instrument(load_config(config))
    reflector = instrument.reflector
    theta_rad = deg_to_rad(np.array([theta_x_deg, theta_y_deg]))
    roughness_rad = arcsec_to_rad(roughness_arcsec)
    perfect, own = (
        _limit_of(variant, rays_per_facet, theta_rad, roughness_rad, seed)
        for variant in (with_common_focal_length(reflector), reflector)
    )
    if as_json:
        report = {
            "schema": "namod-raytrace/1",
            "telescope": instrument.name,
            "n_facets": len(reflector.facets),
            "rays_per_facet": rays_per_facet,
            "theta_deg": [theta_x_deg, theta_y_deg],
            "roughness_arcsec": roughness_arcsec,
            "telescope_focal_length": asdict(perfect),
            "own_focal_lengths": asdict(own),
        }
        typer.echo(json.dumps(report, indent=1))
        return
    Console().print(
        _table(
            f"{instrument.name}: {len(reflector.facets)} aligned facets, {rays_per_facet} rays each, "
            f"star at ({theta_x_deg:g}, {theta_y_deg:g}) deg",
            f"every facet f = {reflector.focal_length_m:g} m",
            perfect,
            own,
        )
    )
    if max(perfect.relative_sampling_error, own.relative_sampling_error) > _SAMPLING_ERROR_WORTH_A_WORD:
        typer.echo("The error from sampling is above 0.5 %: raise --rays-per-facet.")


def _limit_of(
    reflector: Reflector, n_rays: int, theta_rad: NDArray[np.float64], roughness_rad: float, seed: int
) -> _Limit:
    """The traced figures; their sampling error is the change against half as many rays."""
    rng = np.random.default_rng(seed)
    rays = trace(reflector, n_rays, theta_rad, roughness_rad=roughness_rad, rng=rng)
    half = trace(reflector, n_rays // 2, theta_rad, roughness_rad=roughness_rad, rng=rng)
    area, area_of_half = _area_rad2(rays), _area_rad2(half)
    centroid_m = combine_moments(facet_moments(rays)).mean_m
    r80_m = containment_radius_m(rays, 0.8)
    return _Limit(
        rad2_to_arcmin2(area),
        abs(area - area_of_half) / area,
        m_to_mm(r80_m),
        rad_to_arcmin(r80_m / reflector.focal_length_m),
        m_to_mm(float(centroid_m[0])),
        m_to_mm(float(centroid_m[1])),
    )


def _area_rad2(rays: RayTrace) -> float:
    return a_sigma_rad2(combine_moments(facet_moments(rays)).cov_m2, rays.focal_length_m)


def _table(title: str, name_of_perfect: str, perfect: _Limit, own: _Limit) -> Table:
    table = Table(title=title)
    table.add_column("")
    table.add_column(name_of_perfect, justify="right")
    table.add_column("own focal lengths", justify="right")
    labels = (
        "A_sigma / arcmin2",
        "error from sampling / %",
        "r80 / arcmin",
        "r80 / mm",
        "centroid x, y / mm",
    )
    for row in zip(labels, _cells(perfect), _cells(own), strict=True):
        table.add_row(*row)
    return table


def _cells(limit: _Limit) -> tuple[str, ...]:
    # Adding 0 to a rounded figure keeps "-0.00" away.
    return (
        f"{limit.a_sigma_arcmin2:.2f}",
        f"{100.0 * limit.relative_sampling_error:.2f}",
        f"{limit.r80_arcmin:.3f}",
        f"{limit.r80_mm:.2f}",
        f"{round(limit.centroid_x_mm, 2) + 0.0:.2f}, {round(limit.centroid_y_mm, 2) + 0.0:.2f}",
    )
