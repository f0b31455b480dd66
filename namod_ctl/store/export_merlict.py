"""The reflector as a scenery of merlict, the ray tracer of the Cherenkov plenoscope.

A scenery is a tape archive: meshes (`geometry/objects/*.obj`), frames (`geometry/relations.json`: one per facet, with
position and rotation) and materials. Facets are sheets of triangles with the sphere's own normals at the corners;
merlict interpolates the normals, so the mesh's flat triangles do not blur the image. The front is a perfect mirror, the
back absorbs. The frame is the telescope frame, lengths are in m.

Source: files and code of the Python package merlict 0.2.5 (`scenery.string_format`, `tests/resources`).
"""

from __future__ import annotations

import io
import json
import math
import tarfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.raytrace import outline_area_m2
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

Array = NDArray[np.float64]

N_CORNERS = {FacetShape.HEXAGON: 6, FacetShape.SQUARE: 4, FacetShape.ROUND: 96}
N_STEPS = {FacetShape.HEXAGON: 8, FacetShape.SQUARE: 10, FacetShape.ROUND: 8}
"""Steps from a facet's centre to its corner. With 8 the mesh of a facet of FACT lies within 30 um of the sphere."""
MATERIALS = {
    "materials/spectra/no_reflection.csv": "wavelength/m,reflection/1\n2.0e-07,0.0\n1.2e-06,0.0\n",
    "materials/spectra/full_reflection.csv": "wavelength/m,reflection/1\n2.0e-07,1.0\n1.2e-06,1.0\n",
    "materials/spectra/vacuum_absorption.csv": "wavelength/m,absorption/m^{-1}\n2.0e-07,9e99\n1.2e-06,9e99\n",
    "materials/spectra/vacuum_refraction.csv": "wavelength/m,refraction/1\n2.0e-07,1.0\n1.2e-06,1.0\n",
}
SURFACES = {"mirror": ("full_reflection", 0.0, 1.0), "absorber": ("no_reflection", 1.0, 0.0)}


def merlict_scenery(reflector: Reflector, normals: Array, comments: list[str]) -> bytes:
    """The tape archive of a reflector with these unit normals, shape (n_facets, 3), telescope frame.

    `comments` become lines of its README. Positions keep 9 decimals of a metre, rotations 12 digits.
    """
    meshes: dict[tuple[float, FacetShape, float, float], str] = {}
    files: dict[str, str] = {"README.md": "\n".join(["Reflector", "=========", *comments, ""])}
    children = []
    for facet, normal in zip(reflector.facets, normals, strict=True):
        kind = (facet.focal_length_m, facet.shape, facet.width_m, facet.rotation_rad)
        if kind not in meshes:
            meshes[kind] = f"facet_{len(meshes) + 1}"
            files[f"geometry/objects/{meshes[kind]}.obj"] = facet_mesh(facet)
        children.append(
            {
                "id": facet.id,
                "pos": [round(float(value), 9) for value in facet.position_m],
                "rot": _rotation(normal),
                "obj": meshes[kind],
                "mtl": {"mirror": "mirror"},
            }
        )
    root: dict[str, Any] = {"id": 0, "pos": [0, 0, 0], "rot": _rotation(np.array([0.0, 0.0, 1.0]))}
    files["geometry/relations.json"] = json.dumps({"children": [{**root, "children": children}]}, indent=1)
    files |= MATERIALS
    files["materials/media/vacuum.json"] = json.dumps(
        {"type": "transparent", "refraction_spectrum": "vacuum_refraction", "absorption_spectrum": "vacuum_absorption"}
    )
    for name, (spectrum, diffuse, specular) in SURFACES.items():
        files[f"materials/surfaces/{name}.json"] = json.dumps(
            {
                "type": "cook-torrance",
                "reflection_spectrum": spectrum,
                "diffuse_weight": diffuse,
                "specular_weight": specular,
                "roughness": 0.0,
            }
        )
    files["materials/boundary_layers/mirror.json"] = json.dumps(
        {
            "inner": {"medium": "vacuum", "surface": "absorber"},
            "outer": {"medium": "vacuum", "surface": "mirror"},
        }
    )
    files["materials/default_medium.txt"] = "vacuum"
    return _archive(files)


def _rotation(normal: Array) -> dict[str, Any]:
    """The right-handed turn of +z onto `normal` the shortest way, as axis and angle."""
    x, y, z = (float(value) for value in normal)
    sine = math.hypot(x, y)
    axis = [-y / sine, x / sine, 0.0] if sine > 0.0 else [0.0, 0.0, 1.0]
    return {"repr": "axis_angle", "axis": axis, "angle_deg": rad_to_deg(math.atan2(sine, z))}


def facet_mesh(facet: Facet) -> str:
    """A facet's surface as the text of an .obj file: in its own frame, centre at the origin, normal along +z.

    A round facet is a polygon of the same area.
    """
    n_corners, n_steps = N_CORNERS[facet.shape], N_STEPS[facet.shape]
    first = facet.rotation_rad + {FacetShape.HEXAGON: math.pi / 2, FacetShape.SQUARE: math.pi / 4}.get(facet.shape, 0.0)
    corner = 2.0 * math.pi / n_corners
    radius_m = math.sqrt(outline_area_m2(facet) / (0.5 * n_corners * math.sin(corner)))
    # Vertex 0 is the centre; ring k = 1 .. n_steps has k points on each of its sides.
    ring_starts = [0] + [1 + n_corners * k * (k - 1) // 2 for k in range(1, n_steps + 1)]
    points = [np.zeros(2)]
    for ring in range(1, n_steps + 1):
        for side in range(n_corners):
            ends = [
                radius_m * np.array([math.cos(a), math.sin(a)]) for a in (first + corner * np.arange(side, side + 2))
            ]
            points += [ring / n_steps * (ends[0] + (ends[1] - ends[0]) * k / ring) for k in range(ring)]

    def vertex(ring: int, side: int, k: int) -> int:
        """Number, from 1, of point k (0 .. ring) on a side of a ring."""
        return 1 + ring_starts[ring] + ((side * ring + k) % (n_corners * ring) if ring else 0)

    faces = []
    for side in range(n_corners):
        for ring in range(1, n_steps + 1):
            for k in range(ring):
                inner, outer, nearer = vertex(ring - 1, side, k), vertex(ring, side, k), vertex(ring, side, k + 1)
                faces.append((inner, outer, nearer))
                if k + 1 < ring:
                    faces.append((inner, nearer, vertex(ring - 1, side, k + 1)))
    across_m = np.array(points)
    sphere_m = 2.0 * facet.focal_length_m
    upward = np.sqrt(1.0 - np.sum((across_m / sphere_m) ** 2, axis=1))
    height_m = np.sum(across_m**2, axis=1) / sphere_m / (1.0 + upward)
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for (x, y), z in zip(across_m, height_m, strict=True)]
    lines += [
        f"vn {-x / sphere_m:.12f} {-y / sphere_m:.12f} {z:.12f}" for (x, y), z in zip(across_m, upward, strict=True)
    ]
    lines += ["usemtl mirror", *(" ".join(["f", *(f"{v}//{v}" for v in face)]) for face in faces)]
    return "\n".join(lines) + "\n"


def _archive(files: dict[str, str]) -> bytes:
    """A tape archive of text files; the same texts give the same bytes."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for name, text in files.items():
            payload = text.encode()
            entry = tarfile.TarInfo(name)
            entry.size = len(payload)
            archive.addfile(entry, io.BytesIO(payload))
    return data.getvalue()
