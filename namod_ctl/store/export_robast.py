"""The reflector as a table for ROBAST, a ray tracer on ROOT's geometry classes.

ROBAST has no file format of its own: its users build facets in a macro, a `TGeoSphere` cut to the facet's outline and
placed by a `TGeoCombiTrans`. The table has what such a macro needs, and says in its head how it is meant.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

COLUMNS = (
    "facet_id,x_m,y_m,z_m,nx,ny,nz,euler_phi_deg,euler_theta_deg,euler_psi_deg,radius_of_curvature_m,"
    "sphere_x_m,sphere_y_m,sphere_z_m,shape,width_m"
)
HEAD = (
    "Facets of a reflector for ROBAST (ROOT geometry).",
    "Frame: right-handed, origin at the dish vertex, z along the optical axis to the sky, y up with the telescope",
    "  above the horizon; x is then to the left of who looks along the axis to the sky.",
    "Lengths in m (multiply with AOpticsManager::m()), angles in deg.",
    "x y z: centre of the mirror surface. nx ny nz: unit normal there, to the sky.",
    "euler_phi euler_theta euler_psi: the facet's own frame, as TGeoRotation(name, phi, theta, psi) takes them: turn",
    "  about z by phi, then about the new x by theta, then about the new z by psi. Its z is the normal; in it a",
    "  hexagon has a corner at +y (TGeoPgon with phi1 = 30, rmax = width / 2), a square its sides along x and y.",
    "radius_of_curvature: twice the focal length. sphere x y z: centre of the sphere, centre + radius * normal.",
    "width: flat to flat of hexagons and squares, diameter of round facets.",
)


def robast_table(reflector: Reflector, normals: Array, comments: list[str]) -> str:
    """The table for these unit normals, shape (n_facets, 3), telescope frame; lengths to 1 nm, angles to 1e-9 deg."""
    lines = [*(f"# {line}" for line in (*HEAD, *comments)), COLUMNS]
    for facet, normal in zip(reflector.facets, normals, strict=True):
        radius_m = 2.0 * facet.focal_length_m
        fields = [
            str(facet.id),
            *(f"{value:.9f}" for value in facet.position_m),
            *(f"{value:.12f}" for value in normal),
            *(f"{rad_to_deg(angle):.9f}" for angle in euler_angles_rad(normal, facet.rotation_rad)),
            f"{radius_m:.9f}",
            *(f"{value:.9f}" for value in facet.position_m + radius_m * normal),
            facet.shape.value,
            f"{facet.width_m:.9f}",
        ]
        lines.append(",".join(fields))
    return "\n".join(lines) + "\n"


def euler_angles_rad(normal: Array, rotation_rad: float) -> tuple[float, float, float]:
    """phi, theta, psi of ROOT's TGeoRotation for a facet's frame: z along `normal`, turned about it by `rotation_rad`.

    The matrix is Rz(phi) Rx(theta) Rz(psi), so the normal is (sin theta sin phi, -sin theta cos phi, cos theta).
    Source: ROOT reference guide, TGeoRotation, constructor from three Euler angles and `SetAngles`.
    """
    x, y, z = (float(value) for value in normal)
    phi = math.atan2(x, -y) if math.hypot(x, y) > 0.0 else 0.0
    # The shortest way from +z to the normal, which has no twist, is Rz(phi) Rx(theta) Rz(-phi).
    return phi, math.atan2(math.hypot(x, y), z), rotation_rad - phi
