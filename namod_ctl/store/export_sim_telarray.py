"""The lines of a sim_telarray configuration that say how well a reflector is aligned.

sim_telarray takes no orientation per facet: it draws the misalignments at random, with the standard deviations written
here. `horizontal` turns facets about sim_telarray's x, which moves images along its y, the telescope frame's x;
`vertical` moves them along its x, the telescope frame's y. All angles are those of the facets, not of their images.

Source: parameter descriptions of gammasimtools 0.38 (`schemas/model_parameters`), obdeect 0.3 (`docs/PHYSICS.md` and
`compiler.py`, which follow sim_telarray's `sim_config.c` and `sim_imaging.c`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.random_alignment import TiltSpread, ZenithLaw
from namod_ctl.core.units import m_to_cm, rad_to_deg
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ScatterOfRuns:
    """How the facets' tilts scatter.

    Attributes
    ----------
    zenith_rad
        Shape (n_runs,). None for one run at a zenith distance that nobody knows.
    spreads
        One per run.
    laws
        Along telescope x and y.
    blur_rad
        How much wider the facets' own images are than those of ideal facets, per axis; NaN where that is not known.
    """

    zenith_rad: Array | None
    spreads: Sequence[TiltSpread]
    laws: tuple[ZenithLaw, ZenithLaw]
    blur_rad: float


def sim_telarray_config(
    reflector: Reflector, list_name: str, scatter: ScatterOfRuns, comments: Sequence[str], *, has_zenith_terms: bool
) -> str:
    """The lines, which name the mirror list `list_name`; `comments` go first, as remarks.

    `has_zenith_terms` says that runs at several zenith distances were fitted.
    """
    horizontal, vertical = scatter.laws
    lines = [
        *(_remark(comment) for comment in comments),
        _remark(
            "Facets: positions and focal lengths are in the list, with their ids. Orientations are drawn at random."
        ),
        f"mirror_list = {list_name}",
        "mirror_class = 0",
        f"focal_length = {m_to_cm(reflector.focal_length_m):.6f}",
        _remark(
            "Rms of the facets' tilts, zenith distance of the least, cosine and sine factor, added in squares [deg]."
        ),
        *(_remark(line) for line in _scatter_remarks(scatter)),
    ]
    if not has_zenith_terms:
        lines.append(_remark("One run: no zenith terms; the numbers hold for its zenith distance only."))
    lines += [
        f"mirror_align_random_horizontal = {_four_numbers(horizontal)}",
        f"mirror_align_random_vertical = {_four_numbers(vertical)}",
        _remark(
            "Not measured by this method, which sees angles only. The list gives every facet a z and a focal length of"
        ),
        _remark("its own, and sim_telarray then uses neither of the two."),
        "mirror_align_random_distance = 0.",
        "random_focal_length = 0.,0.",
    ]
    if np.isfinite(scatter.blur_rad):
        blur_deg = rad_to_deg(scatter.blur_rad)
        lines += [
            _remark(
                f"The facets' own images are {blur_deg:.5f} deg wider than an ideal mirror's, rms per axis. In this"
            ),
            _remark(
                "are figure errors, the star's image and the reflector camera's aperture. An upper limit, for who has"
            ),
            _remark(f"no better number: mirror_reflection_random_angle = {blur_deg:.5f},0.,0."),
        ]
    lines.append(_remark("focus_offset, camera and everything else: not known here, keep your own."))
    return "\n".join(lines) + "\n"


def _remark(text: str) -> str:
    return f"% {text}"


def _four_numbers(law: ZenithLaw) -> str:
    constant, z0, cosine, sine = (
        rad_to_deg(value) for value in (law.constant_rad, law.z0_rad, law.cosine_rad, law.sine_rad)
    )
    return f"{constant:.6f},{z0:.4f},{cosine:.6f},{sine:.6f}"


def _scatter_remarks(scatter: ScatterOfRuns) -> list[str]:
    """What the scatter is at each run, and what the law says there."""
    lines = []
    for k, spread in enumerate(scatter.spreads):
        where, zenith_rad = "", 0.0
        if scatter.zenith_rad is not None:
            zenith_rad = float(scatter.zenith_rad[k])
            where = f" at zenith distance {rad_to_deg(zenith_rad):.1f} deg"
        axes = [
            f"{name} {rad_to_deg(float(spread.sigma_rad[axis])):.5f} "
            f"+- {rad_to_deg(float(spread.sigma_uncertainty_rad[axis])):.5f} "
            f"(law {rad_to_deg(float(law.sigma_rad(np.array(zenith_rad)))):.5f})"
            for axis, (name, law) in enumerate(zip(("horizontal", "vertical"), scatter.laws, strict=True))
        ]
        lines.append(f"  {spread.n_facets} facets{where}: {', '.join(axes)}")
    drawn_percent = 100.0 * scatter.spreads[0].drawn_share
    lines.append(
        f"  The estimates' noise is taken off in squares. As many tilts drawn anew scatter by {drawn_percent:.0f} %."
    )
    return lines
