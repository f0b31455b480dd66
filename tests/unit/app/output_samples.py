"""Instruments and alignments of known content for the tests of what the program writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf, BadRecord, FacetAlignment
from namod_ctl.reconstruction.responses import ResponseTable

FACT_DATA = Path(__file__).parents[3] / ".." / "shared" / "data" / "fact_2014"


def hexagon_px(centre, width_px):
    """Corners of an upright hexagon in a picture."""
    angles = np.pi / 2 + np.pi / 3 * np.arange(6)
    return np.asarray(centre) + width_px / np.sqrt(3) * np.column_stack([np.cos(angles), np.sin(angles)])


def camera(n_columns, n_rows, orientation=CameraOrientation()):  # noqa: B008 - frozen
    axis = np.array([(n_columns - 1) / 2, (n_rows - 1) / 2])
    law = RadiometricLaw(1.0, -1.0, 0.0)
    return CameraModel("camera", n_columns, n_rows, 1e-3, axis, True, orientation, law)


def tripod(legs=3, radius_m=0.295, pitch_m=1e-3):
    angles = 2 * np.pi / legs * np.arange(legs)
    return Mount(radius_m * np.column_stack([np.cos(angles), np.sin(angles)]), False, 0.1, 0.0, pitch_m)


def instrument_of(reflector, polygons_px, n_columns=1024, n_rows=768, mount=None, orientation=CameraOrientation()):  # noqa: B008
    mount = mount or tripod()
    return Instrument(
        "FACT",
        reflector,
        dict.fromkeys(reflector.ids, mount),
        camera(2560, 1920),
        camera(n_columns, n_rows, orientation),
        polygons_px,
        deg_to_rad(10.0),
        deg_to_rad(0.025),
    )


def honeycomb(n_facets, width_m, focal_length_m, first_id=1):
    """The n facets of a honeycomb nearest to the axis, without the innermost one."""
    n = int(np.sqrt(n_facets)) + 3
    row, column = np.mgrid[-n : n + 1, -n : n + 1]
    x = (width_m * 1.02 * (column + 0.5 * (row % 2))).ravel()
    y = (width_m * 1.02 * np.sqrt(0.75) * row).ravel()
    nearest = np.argsort(np.hypot(x, y) + 1e-6 * np.arctan2(y, x))[1 : n_facets + 1]
    facets = [
        Facet(
            i,
            np.array([x[k], y[k], (x[k] ** 2 + y[k] ** 2) / 4 / focal_length_m]),
            focal_length_m,
            FacetShape.HEXAGON,
            width_m,
        )
        for i, k in enumerate(nearest, first_id)
    ]
    return Reflector(focal_length_m, tuple(facets))


def published_fact():
    """FACT as in the published instruction picture, 1215 x 911 pixels: 29 facets, and the places of their tripods."""
    rows = np.loadtxt(FACT_DATA / "published_facet_pixels.csv", delimiter=",", skiprows=1)
    m_per_px = 0.62 / 137.0
    facets = tuple(
        Facet(int(i), np.array([(x - 645) * m_per_px, (475 - y) * m_per_px, 0.1]), 4.889, FacetShape.HEXAGON, 0.606)
        for i, x, y in rows
    )
    polygons = {int(i): hexagon_px((x, y), 134.0) for i, x, y in rows}
    return instrument_of(Reflector(4.889, facets), polygons, 1215, 911)


def facet_alignment(facet_id, theta_deg=(0.05, -0.02), mount=None, flags=FacetFlag.NONE, remarks=()):
    mount = mount or tripod()
    theta = deg_to_rad(np.array(theta_deg))
    phi = -theta / 2
    travel = -(mount.legs_m @ phi)
    turns = travel / mount.pitch_m_per_turn * 360 if mount.pitch_m_per_turn else np.zeros(0)
    cov = deg_to_rad(0.004) ** 2 * np.array([[1.0, 0.3], [0.3, 0.7]])
    return FacetAlignment(
        facet_id, theta, cov, deg_to_rad(0.03), deg_to_rad(0.02), 1e-6, 0.05, 40, flags, phi, travel, turns, remarks
    )


def unknown_facet(facet_id, n_bolts=3):
    nan2, nan22 = np.full(2, np.nan), np.full((2, 2), np.nan)
    nans = np.full(n_bolts, np.nan)
    return FacetAlignment(
        facet_id, nan2, nan22, np.nan, np.nan, np.nan, np.nan, 0, FacetFlag.NO_SIGNAL, nan2, nans, nans, ("dark",)
    )


def alignment_of(facets: Sequence[FacetAlignment], **changes) -> Alignment:
    arguments = {
        "telescope": "FACT",
        "estimator": "robust",
        "n_records": 300,
        "n_used": 288,
        "axis_rad": deg_to_rad(np.array([0.01, -0.02])),
        "now": AreaOfPsf(5.3e-6, 2e-7),
        "now_all_records": AreaOfPsf(9.9e-6, 4e-7),
        "predicted": AreaOfPsf(6e-7, 3e-8),
        "facets": tuple(facets),
        "bad_records": (BadRecord(17, "wrong_star", "8 facets lit at once, far from their centres", (12, 16, 29)),),
        "facets_not_in_run": (14,),
        "remarks": ("background left out",),
    }
    return Alignment(**(arguments | changes))


def random_alignment(reflector, seed=1, sigma_deg=0.05, **changes):
    """Some of everything: turns large and small, no signal, unreliable facets, cut PSFs."""
    rng = np.random.default_rng(seed)
    facets = []
    for count, facet_id in enumerate(reflector.ids):
        theta_deg = rng.normal(0, sigma_deg, 2)
        if count % 13 == 5:
            facets.append(unknown_facet(facet_id))
        elif count % 11 == 3:
            facets.append(facet_alignment(facet_id, theta_deg, flags=FacetFlag.UNRELIABLE | FacetFlag.FEW_RECORDS))
        elif count % 7 == 2:
            facets.append(facet_alignment(facet_id, theta_deg * 0.05))
        elif count % 7 == 4:
            facets.append(facet_alignment(facet_id, theta_deg, flags=FacetFlag.PSF_CUT_BY_SCAN_EDGE))
        else:
            facets.append(facet_alignment(facet_id, theta_deg))
    return alignment_of(facets, **changes)


def fact_response_table() -> ResponseTable:
    """The published response maps as they are."""
    paths = sorted(
        (FACT_DATA / "response_maps").glob("*.csv"), key=lambda path: int(path.stem.split("ID")[1].split("_")[0])
    )
    maps = [np.loadtxt(path, delimiter=",", skiprows=1) for path in paths]
    ids = tuple(int(path.stem.split("ID")[1].split("_")[0]) for path in paths)
    n = len(maps[0])
    theta = deg_to_rad(maps[0][:, :2])
    response = np.column_stack([m[:, 2] for m in maps])
    return ResponseTable(ids, np.arange(n), theta, np.full(n, np.nan), response, np.ones(n))
