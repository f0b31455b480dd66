"""What people write behind the options of `namod-ctl lut`, as numbers and words that are checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.gravity_runs import CAME_FROM_RAD
from namod_ctl.calibration.gravity.gravity_table import Side
from namod_ctl.core.errors import ConfigError

Array = NDArray[np.float64]


def zeniths_of_words(text: str, n_runs: int) -> list[float]:
    """Zenith distances in deg, one for each run. Raises ConfigError."""
    try:
        angles = [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--zenith-deg {text}: give numbers with commas between: 10,25,40,60") from None
    if len(angles) != n_runs:
        raise ConfigError(f"--zenith-deg {text}: {len(angles)} numbers for {n_runs} runs; give one for each, in order")
    wrong = [angle for angle in angles if not 0.0 <= angle <= 90.0]
    if wrong:
        raise ConfigError(
            f"--zenith-deg {text}: {wrong[0]:g} is no zenith distance; 0 is the zenith, 90 the horizon (altitude is 90 "
            "minus that)"
        )
    return angles


def sides_of_words(text: str, n_runs: int) -> list[str]:
    """From where the telescope came, one for each run. Raises ConfigError."""
    sides = [part.strip() for part in text.split(",")]
    wrong = [side for side in sides if side not in CAME_FROM_RAD]
    if wrong or len(sides) != n_runs:
        problem = f"{wrong[0]!r} is no side" if wrong else f"{len(sides)} sides for {n_runs} runs"
        raise ConfigError(f"--from {text}: {problem}; give {', '.join(CAME_FROM_RAD)} for each run, in order")
    return sides


def side_of_words(text: str) -> Side:
    """From where the telescope comes. Raises ConfigError."""
    match text:
        case "above" | "below":
            return text
    raise ConfigError(f"--from {text}: say above (from the zenith) or below")


def weights_of_words(text: str, zenith_deg: Array) -> Array:
    """Observing time at `zenith_deg` (n,), straight between those that are given. Raises ConfigError."""
    try:
        pairs = [tuple(map(float, part.split(":"))) for part in text.split(",")]
        angles, values = (np.array(column) for column in zip(*pairs, strict=True))
    except ValueError:
        raise ConfigError(f"--weights {text}: give zenith distance:weight with commas between: 5:1,20:3,65:1") from None
    if np.any(np.diff(angles) <= 0.0) or np.any(values < 0.0) or not np.all(np.isfinite(values)):
        raise ConfigError(f"--weights {text}: zenith distances must ascend, and weights must not be negative")
    found = np.interp(zenith_deg, angles, values)
    if not found.sum() > 0.0:
        raise ConfigError(f"--weights {text}: all weights between --from-deg and --to-deg are 0")
    return np.asarray(found, dtype=np.float64)


def stars_of_words(text: str, n_runs: int) -> list[str]:
    """Names of stars, one for each run. Raises ConfigError."""
    names = [part.strip() for part in text.split(",")]
    names = names * n_runs if len(names) == 1 else names
    if len(names) != n_runs or not all(names):
        raise ConfigError(f"--star {text}: {len(names)} names for {n_runs} runs; give one for all, or one for each")
    return names
