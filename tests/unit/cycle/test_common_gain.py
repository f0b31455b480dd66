"""A sign or a pitch that is wrong for all legs, told from faults of single facets; truth by the geometry of planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moved_facets import FACT_TRIPOD, UM, Dish

from namod_ctl.cycle.common_gain import common_gain
from namod_ctl.cycle.learn import observed

RESOLUTION_M = 3 * UM


def gain_seen(true_gain: float, facets: int, n_others: int, seed: int) -> float:
    """The dish's legs move by `true_gain`, but for `n_others` of its facets, which move as they are told."""
    mount = replace(FACT_TRIPOD, backlash_m=0.0)  # play takes its own share off short travels
    dish = Dish(mount, facets, 0.2, np.random.default_rng(seed))
    orders = dish.orders()
    for facet_id in dish.ids[n_others:]:
        for leg in range(dish.n_legs):
            dish.wiring[facet_id, leg] = (facet_id, leg, true_gain)
    observation = dish.move(orders)
    return common_gain(observed(dish.mounts, [observation], RESOLUTION_M))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("true_gain", [-1.0, 2.0])
@pytest.mark.parametrize("n_others", [0, 2])
def test_what_is_wrong_for_all_is_found(true_gain: float, n_others: int, seed: int) -> None:
    """Tolerance: noise of 0.2 arcmin on changes of some 5 arcmin, twice, over 10 facets."""
    assert gain_seen(true_gain, 12, n_others, seed) == pytest.approx(true_gain, rel=0.04)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("true_gain", "n_others"), [(1.0, 0), (-1.0, 8), (2.0, 8)])
def test_faults_of_some_facets_are_not_the_config_s(true_gain: float, n_others: int, seed: int) -> None:
    assert gain_seen(true_gain, 12, n_others, seed) == 1.0
