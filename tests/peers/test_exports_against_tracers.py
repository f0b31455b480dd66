"""Exported files in foreign hands: read by readers that share no code with the writers, traced by batoid and merlict.

The rays are those of our own tracer, on the reflector that was exported; where they hit and where they go is the
foreign program's business. batoid is given spheres as the file says them, merlict reads and traces its file itself.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from astropy.table import QTable
from scipy.spatial.transform import Rotation

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import rad2_to_arcmin2
from namod_ctl.optics.raytrace import (
    RayTrace,
    a_sigma_rad2,
    combine_moments,
    facet_moments,
    sample_surface,
    tilted_normals,
    trace,
)
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.store.export_merlict import merlict_scenery
from namod_ctl.store.export_robast import robast_table
from namod_ctl.store.export_table import add_geometry
from namod_ctl.store.facet_lists import format_mars, format_sim_telarray

N_RAYS = 200
TO_SKY = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Mirror:
    """One facet as a file says it, in m and in the file's own frame."""

    centre: np.ndarray
    normal: np.ndarray
    radius: float


@pytest.fixture(scope="module")
def fact() -> Reflector:
    return build_instrument(load_config("fact")).reflector


@pytest.fixture(scope="module")
def tilts() -> np.ndarray:
    return 0.001 * np.random.default_rng(4).standard_normal((30, 2))


def a_sigma_arcmin2(hits_m: np.ndarray, light_m2: np.ndarray, focal_length_m: float) -> float:
    moments = combine_moments(facet_moments(RayTrace(focal_length_m, hits_m, light_m2)))
    return float(rad2_to_arcmin2(a_sigma_rad2(moments.cov_m2, focal_length_m)))


def starts_m(reflector: Reflector, normals: np.ndarray) -> np.ndarray:
    """Where the rays of an on-axis star start, 3 m above the facets; (n_facets, N_RAYS, 3)."""
    facets = zip(reflector.facets, normals, strict=True)
    return np.array([sample_surface(facet, normal, N_RAYS)[0] + 3.0 * TO_SKY for facet, normal in facets])


def batoid_hits_m(mirrors: list[Mirror], start_m: np.ndarray, focal_length_m: float) -> np.ndarray:
    batoid = pytest.importorskip("batoid", reason="batoid is not installed (extra `peers`)")
    hits = []
    for mirror, start in zip(mirrors, start_m, strict=True):
        rays = batoid.RayVector(*start.T.copy(), *(np.full(N_RAYS, value) for value in (0.0, 0.0, -1.0)))
        x, y, z = mirror.normal
        lean = batoid.RotY(np.arctan2(x, z)) @ batoid.RotX(-np.arcsin(y / np.linalg.norm(mirror.normal)))
        batoid.Sphere(mirror.radius).reflect(rays, coordSys=batoid.CoordSys(origin=mirror.centre, rot=lean))
        batoid.Plane().intersect(rays, coordSys=batoid.CoordSys(origin=[0.0, 0.0, focal_length_m]))
        assert not rays.failed.any()
        hits.append(np.column_stack([rays.x, rays.y]))
    return np.array(hits)


def read_mars_columns(text: str) -> list[Mirror]:
    rows = np.genfromtxt(text.splitlines(), usecols=range(7))
    return [Mirror(row[:3] / 100.0, row[3:6], 2.0 * row[6] / 100.0) for row in rows]


def read_robast_rows(text: str) -> list[Mirror]:
    """By the Euler angles, as ROOT's TGeoRotation means them: z, new x, new z."""
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    mirrors = []
    for row in rows:
        angles = [float(row[f"euler_{name}_deg"]) for name in ("phi", "theta", "psi")]
        normal = Rotation.from_euler("ZXZ", angles, degrees=True).apply(TO_SKY)
        centre = np.array([float(row[f"{axis}_m"]) for axis in "xyz"])
        mirrors.append(Mirror(centre, normal, float(row["radius_of_curvature_m"])))
    return mirrors


def read_ecsv_rows(path: Path) -> list[Mirror]:
    table = QTable.read(path)
    return [
        Mirror(
            np.array([row[f"position_{axis}"].to_value("m") for axis in "xyz"]),
            np.array([float(row[f"normal_{axis}"]) for axis in "xyz"]),
            2.0 * row["focal_length"].to_value("m"),
        )
        for row in table
    ]


def write_table(path: Path, reflector: Reflector, normals: np.ndarray) -> list[Mirror]:
    table = QTable({"facet_id": list(reflector.ids)})
    add_geometry(table, reflector, normals)
    table.write(path)
    return read_ecsv_rows(path)


FORMS: dict[str, Callable[[Path, Reflector, np.ndarray], list[Mirror]]] = {
    "mars": lambda _, reflector, normals: read_mars_columns(format_mars(reflector, normals)),
    "robast": lambda _, reflector, normals: read_robast_rows(robast_table(reflector, normals, [])),
    "ecsv": lambda folder, reflector, normals: write_table(folder / "t.ecsv", reflector, normals),
    "fits": lambda folder, reflector, normals: write_table(folder / "t.fits", reflector, normals),
}


@pytest.mark.parametrize("form", FORMS)
def test_batoid_traces_from_the_file_what_we_trace(
    form: str, fact: Reflector, tilts: np.ndarray, tmp_path: Path
) -> None:
    normals = tilted_normals(fact, tilts)
    mirrors = FORMS[form](tmp_path, fact, normals)
    ours = trace(fact, N_RAYS, None, tilts)
    hits = batoid_hits_m(mirrors, starts_m(fact, normals), fact.focal_length_m)
    # positions are written to 1 or 10 nm, normals to 1e-10: 5 m away 1 nm
    np.testing.assert_allclose(hits, ours.hit_m, rtol=0, atol=5e-8)
    expected = a_sigma_arcmin2(ours.hit_m, ours.light_m2, fact.focal_length_m)
    assert a_sigma_arcmin2(hits, ours.light_m2, fact.focal_length_m) == pytest.approx(expected, rel=1e-6)


def sim_telarray_mirrors(text: str, horizontal: np.ndarray, vertical: np.ndarray) -> list[Mirror]:
    """As sim_telarray places mirrors, in its frame, with these random tilts (rad).

    Source: obdeect 0.3.0, `compiler.py`, `_nominal_placement` and `_panel_alignment`, which follow `sim_imaging.c`:
    the inclination is half of asin(radius / distance to the focus), the normal that of two Euler angles.
    """
    mirrors = []
    rows = np.genfromtxt(text.splitlines(), usecols=range(6)) / 100.0
    for (x, y, _, focal_length, _, z), h, v in zip(rows, horizontal, vertical, strict=True):
        radius, phi = np.hypot(x, y), np.arctan2(y, x)
        inclination = 0.5 * np.arcsin(radius / np.hypot(4.889 - z, radius)) - h * np.sin(phi) + v * np.cos(phi)
        gamma = h * np.cos(phi) + v * np.sin(phi)
        c, t, ci, si = np.cos(phi), np.sin(phi), np.cos(inclination), np.sin(inclination)
        cg, sg = np.cos(gamma), np.sin(gamma)
        normal = np.array([-c * si * cg - t * sg, -t * si * cg + c * sg, ci * cg])
        mirrors.append(Mirror(np.array([x, y, z]), normal, 2.0 * focal_length))
    return mirrors


def to_sim_telarray(vectors: np.ndarray) -> np.ndarray:
    """Our frame, x left and y up as one looks to the sky, in theirs, x down and y left."""
    return np.concatenate([-vectors[..., 1:2], vectors[..., :1], vectors[..., 2:]], axis=-1)


def test_a_sim_telarray_list_of_an_aligned_mirror_gives_our_limit(fact: Reflector) -> None:
    ours, zero = trace(fact, N_RAYS), np.zeros(30)
    mirrors = sim_telarray_mirrors(format_sim_telarray(fact), zero, zero)
    hits = batoid_hits_m(mirrors, to_sim_telarray(starts_m(fact, fact.aligned_normals())), fact.focal_length_m)
    np.testing.assert_allclose(hits, to_sim_telarray(ours.hit_m), rtol=0, atol=5e-8)
    expected = a_sigma_arcmin2(ours.hit_m, ours.light_m2, fact.focal_length_m)
    assert a_sigma_arcmin2(hits, ours.light_m2, fact.focal_length_m) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("axis", "name"), [(0, "horizontal"), (1, "vertical")])
def test_what_scatters_along_our_axis_scatters_images_along_theirs(fact: Reflector, axis: int, name: str) -> None:
    """Facets that nod up and down spread the image up and down, in sim_telarray along its x, drawn as `vertical`."""
    tilts = np.zeros((30, 2))
    tilts[:, axis] = 1e-3 * np.random.default_rng(2).standard_normal(30)
    ours = to_sim_telarray(trace(fact, N_RAYS, None, tilts).hit_m).mean(axis=1)
    drawn = {"horizontal": np.zeros(30), "vertical": np.zeros(30)} | {name: tilts[:, axis]}
    mirrors = sim_telarray_mirrors(format_sim_telarray(fact), drawn["horizontal"], drawn["vertical"])
    start = to_sim_telarray(starts_m(fact, fact.aligned_normals()))
    theirs = batoid_hits_m(mirrors, start, fact.focal_length_m).mean(axis=1)
    np.testing.assert_allclose(theirs.std(axis=0), ours.std(axis=0), rtol=0.03, atol=2e-4)  # 0.03: the obliquity
    assert np.argmax(theirs.std(axis=0)) == 1 - axis


def merlict_hits_m(path: Path, start_m: np.ndarray, focal_length_m: float) -> np.ndarray:
    """Where rays go after merlict's own intersection with the scenery and its surface normals there."""
    merlict = pytest.importorskip("merlict", reason="merlict is not installed (extra `peers`)")
    scenery = merlict.open(str(path))
    rays = merlict.ray.init(start_m[..., 0].size)
    for column, axis in enumerate("xyz"):
        rays[f"support.{axis}"] = start_m[..., column].ravel()
        rays[f"direction.{axis}"] = -TO_SKY[column]
    is_hit, found = scenery.query_intersectionSurfaceNormal(rays)
    assert np.all(is_hit)
    assert np.all(found["from_outside_to_inside"])  # on the side that mirrors
    point, normal = (
        np.column_stack([found[f"{name}.{axis}"] for axis in "xyz"]) for name in ("position", "surface_normal")
    )
    reflected = 2.0 * normal[:, 2:] * normal - TO_SKY
    hits = point[:, :2] + reflected[:, :2] * ((focal_length_m - point[:, 2]) / reflected[:, 2])[:, None]
    return hits.reshape(*start_m.shape[:2], 2)


@pytest.mark.parametrize("name", ["fact", "mst_like"])
def test_merlict_reads_its_scenery_and_traces_what_we_trace(name: str, tmp_path: Path) -> None:
    reflector = build_instrument(load_config(name)).reflector
    tilts = 0.001 * np.random.default_rng(4).standard_normal((len(reflector.facets), 2))
    normals = tilted_normals(reflector, tilts)
    (tmp_path / "scenery.tar").write_bytes(merlict_scenery(reflector, normals, ["a test"]))
    ours = trace(reflector, N_RAYS, None, tilts)
    hits = merlict_hits_m(tmp_path / "scenery.tar", starts_m(reflector, normals), reflector.focal_length_m)
    np.testing.assert_allclose(hits, ours.hit_m, rtol=0, atol=2e-5)  # triangles lie up to 30 um off the sphere
    expected = a_sigma_arcmin2(ours.hit_m, ours.light_m2, reflector.focal_length_m)
    assert a_sigma_arcmin2(hits, ours.light_m2, reflector.focal_length_m) == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("shape", list(FacetShape))
def test_merlict_sees_the_outline_of_a_turned_facet(shape: FacetShape, tmp_path: Path) -> None:
    """Rays on a grid meet the facet exactly where its outline is; a hexagon at 0 has its corner at +y."""
    rotation_rad = 0.2
    facet = Facet(5, np.array([0.0, 0.0, 0.0]), 10.0, shape, 1.0, rotation_rad)
    (tmp_path / "one.tar").write_bytes(merlict_scenery(Reflector(10.0, (facet,)), TO_SKY[None, :], []))
    merlict = pytest.importorskip("merlict", reason="merlict is not installed (extra `peers`)")
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-0.8, 0.8, 41) + 1e-4]))
    rays = merlict.ray.init(len(x))
    rays["support.x"], rays["support.y"], rays["support.z"] = x, y, 3.0
    rays["direction.x"], rays["direction.y"], rays["direction.z"] = 0.0, 0.0, -1.0
    is_hit, _ = merlict.open(str(tmp_path / "one.tar")).query_intersectionSurfaceNormal(rays)
    u = np.cos(rotation_rad) * x + np.sin(rotation_rad) * y
    v = np.cos(rotation_rad) * y - np.sin(rotation_rad) * x
    flats = {
        FacetShape.HEXAGON: np.max(
            [abs(u), abs(0.5 * u + np.sqrt(0.75) * v), abs(0.5 * u - np.sqrt(0.75) * v)], axis=0
        ),
        FacetShape.SQUARE: np.maximum(abs(u), abs(v)),
        FacetShape.ROUND: np.hypot(u, v),
    }[shape]
    is_clear = abs(flats - 0.5) > 1e-3
    np.testing.assert_array_equal(np.asarray(is_hit, dtype=bool)[is_clear], (flats < 0.5)[is_clear])


def test_a_facet_tilted_to_the_right_throws_the_star_to_the_right_in_every_form(tmp_path: Path) -> None:
    """Seen from the focal point: +x right, +y up. By the law of mirrors the image moves by 2 t f."""
    focal_length, tilt = 10.0, np.array([2e-3, -1e-3])
    facet = Facet(5, np.array([0.0, 0.0, 0.0]), focal_length, FacetShape.HEXAGON, 0.1)
    reflector = Reflector(focal_length, (facet,))
    normals = tilted_normals(reflector, tilt[None, :])
    for form, read in FORMS.items():
        (mirror,) = read(tmp_path, reflector, normals) if form != "mars" else [one_of_mars(reflector, normals)]
        reflected = 2.0 * mirror.normal[2] * mirror.normal - TO_SKY
        np.testing.assert_allclose(focal_length * reflected[:2] / reflected[2], 2.0 * tilt * focal_length, rtol=1e-4)
    (tmp_path / "one.tar").write_bytes(merlict_scenery(reflector, normals, []))
    hits = merlict_hits_m(tmp_path / "one.tar", starts_m(reflector, normals), focal_length)
    np.testing.assert_allclose(hits.mean(axis=(0, 1)), 2.0 * tilt * focal_length, rtol=1e-3)


def one_of_mars(reflector: Reflector, normals: np.ndarray) -> Mirror:
    row = format_mars(reflector, normals).splitlines()[-1].split()
    numbers = np.array(row[:7], dtype=float)
    return Mirror(numbers[:3] / 100.0, numbers[3:6], 2.0 * numbers[6] / 100.0)


@pytest.mark.parametrize("rotation_rad", [0.0, 0.3])
def test_robasts_euler_angles_turn_the_outline_as_ours(rotation_rad: float) -> None:
    """ROOT's matrix, written out from the guide of TGeoRotation, puts a hexagon's corner where our outline has it."""
    facet = Facet(5, np.array([1.0, -0.5, 0.2]), 5.0, FacetShape.HEXAGON, 0.6, rotation_rad)
    reflector = Reflector(5.0, (facet,))
    normal = tilted_normals(reflector, np.zeros((1, 2)))[0]
    text = robast_table(reflector, normal[None, :], [])
    row = next(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    phi, theta, psi = (np.radians(float(row[f"euler_{name}_deg"])) for name in ("phi", "theta", "psi"))
    cf, sf, ct, st, cp, sp = (f(a) for a in (phi, theta, psi) for f in (np.cos, np.sin))
    matrix = np.array(
        [
            [cp * cf - ct * sf * sp, -sp * cf - ct * sf * cp, st * sf],
            [cp * sf + ct * cf * sp, -sp * sf + ct * cf * cp, -st * cf],
            [sp * st, cp * st, ct],
        ]
    )
    np.testing.assert_allclose(matrix[:, 2], normal, atol=1e-10)
    corner = np.array([0.0, 0.6 / np.sqrt(3.0), 0.0])
    outline = sample_surface(facet, normal, 20_000)[0] - facet.position_m
    farthest = outline[np.argmax(outline @ (matrix @ np.array([0.0, 1.0, 0.0])))]
    np.testing.assert_allclose(farthest, matrix @ corner, atol=0.012)  # and the sphere's sag there
