"""Numbers as they go to the page: few digits, None for what is not known."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

_DIGITS = 5


def short(value: float) -> float | None:
    """The number with as many digits as a page can use; None for NaN and infinity, which JSON does not know."""
    value = float(value)
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def shorts(values: Iterable[float] | np.ndarray) -> list[float | None]:
    """`short` of each."""
    return [short(value) for value in values]
