"""Stars that get bright and faint over a made run, and cameras whose calibrations do not match."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

SCINTILLATION = 0.09
"""Of the star in the star camera's small lens, as the twin's and Young's formula have it for 0.1 s."""


def clouds(rng, n, depth_mag=2.5, period=90.0):
    """Magnitudes (n,) that clouds cost, smooth over `period` records."""
    phase = 2 * np.pi * (np.arange(n)[:, None] / period * rng.uniform(0.5, 2.0, 4) + rng.random(4))
    return depth_mag * np.clip(0.5 + np.sin(phase).mean(axis=1) / 0.7, 0, 1)


def stars(rng, n, magnitudes=(0.0, 2.3, 1.2)):
    """Magnitudes (n,) of one star after the other."""
    return np.repeat(magnitudes, -(-n // len(magnitudes)))[:n]


def under_star(made, rng, magnitude, exponent=0.0, star_noise=SCINTILLATION):
    """The made run as cameras see it when the star has these magnitudes (n,).

    What does not come from the star stays as it is when the star fades. `exponent` is the power of the star's
    intensity by which the recovered responses are wrong.
    """
    true = 10.0 ** (-0.4 * magnitude)
    measured = true * np.exp(star_noise * rng.normal(size=len(true)))
    dark = made.table.response.min(axis=0)
    intensity = (made.table.response - dark) * (true ** (1.0 + exponent))[:, None] + dark
    intensity -= np.quantile(intensity, 0.1, axis=0)
    table = replace(made.table, response=intensity / measured[:, None], faintness=np.median(measured) / measured)
    return replace(made, table=table)
