"""What all figures share: colours, resolution, ellipses.

Colours are of the viridis map and of Okabe and Ito's palette, which people with any colour vision tell apart; what
matters is also told apart by shape or word. Figures are built without matplotlib's global state.
"""

from __future__ import annotations

import io
import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_deg

DPI = 120
ORANGE, SKY, VERMILLION = "#e69f00", "#56b4e9", "#d55e00"
NOT_SEEN = "#e4e4e4"
PNG_SUFFIX = ".png"


def colours() -> Colormap:
    """The colour map of all figures; NaN is light grey."""
    return mpl.colormaps["viridis"].with_extremes(bad=NOT_SEEN)


def ellipse_axes(cov: NDArray[np.float64]) -> tuple[float, float, float]:
    """Full major and minor axis of the 1-sigma ellipse and the angle of the major axis from +x, deg; NaN for NaN."""
    if not np.all(np.isfinite(cov)):
        return math.nan, math.nan, math.nan
    variances, directions = np.linalg.eigh(cov)
    minor, major = 2.0 * np.sqrt(np.maximum(variances, 0.0))
    return float(major), float(minor), rad_to_deg(math.atan2(directions[1, 1], directions[0, 1]))


def picture_beside(path: Path) -> Path:
    """The picture that belongs to the file `path`. Raises ConfigError where it would take that file's own place."""
    picture = path.with_suffix(PNG_SUFFIX)
    if picture == path:
        raise ConfigError(f"{path}: this is the name of the picture that is written beside it; end it with .json")
    return picture


def figure_to_png(figure: Figure) -> bytes:
    """The figure as PNG at its own resolution."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=figure.dpi)
    return data.getvalue()
