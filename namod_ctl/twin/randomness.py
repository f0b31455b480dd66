"""Random generators by name: what is drawn for one thing never depends on what was drawn for another."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, purpose: str, number: int = 0) -> np.random.Generator:
    """The generator of one purpose (and of its n-th use) of a twin of that seed."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), number])
