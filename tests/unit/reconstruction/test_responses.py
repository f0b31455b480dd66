"""The response table against light whose parts are known."""

from __future__ import annotations

import numpy as np

from namod_ctl.core.records import Record
from namod_ctl.reconstruction.responses import tabulate_responses


def _record(index: int, star: float, lit: float, scene: float) -> Record:
    return Record(
        index=index,
        label=str(index),
        theta_rad=np.array([1e-3 * index, 0.0]),
        theta_uncertainty_rad=np.nan,
        star_intensity=star,
        facet_intensity=np.array([scene + lit * star]),
        facet_saturated_share=np.zeros(1),
        star_exposure_s=np.nan,
        reflector_exposure_s=np.nan,
    )


def test_a_cloud_changes_no_response() -> None:
    """Light of the star fades with the star, the scene on the facet does not: lit records say the same throughout."""
    star = np.where(np.arange(100) % 2, 1.0, 1.0 / 30.0)
    lit = np.where(np.arange(100) < 20, 0.4, 0.0)
    table = tabulate_responses([_record(i, star[i], lit[i], 0.01) for i in range(100)], [7])
    np.testing.assert_allclose(table.response[:, 0], lit, atol=1e-12)


def test_under_a_steady_star_responses_are_the_plain_quotient() -> None:
    lit = np.where(np.arange(100) < 20, 0.4, 0.0)
    table = tabulate_responses([_record(i, 2.0, lit[i], 0.01) for i in range(100)], [7])
    np.testing.assert_allclose(table.response[:, 0], lit + 0.005, atol=1e-12)
