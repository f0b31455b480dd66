"""Records of several runs as those of one: names, order of facets, times, and copies that would count twice."""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.store.combine import RunPart, merge_records


def records(seed: int, n: int = 3, first_s: float = 0.0) -> tuple[Record, ...]:
    """Records of facets 7 and 9, of which the second one is rejected."""
    rng = np.random.default_rng(seed)
    return tuple(
        Record(
            index=10 * i,
            label=f"stamp{i}",
            theta_rad=rng.normal(size=2),
            theta_uncertainty_rad=1e-5,
            star_intensity=rng.random(),
            facet_intensity=rng.random(2),
            facet_saturated_share=np.array([0.7, 0.9]),
            star_exposure_s=0.1,
            reflector_exposure_s=0.2,
            reject_reason=RejectReason.STAR_STREAK if i == 1 else None,
            detail="a satellite" if i == 1 else "",
            star_mid_exposure_s=first_s + i,
            reflector_mid_exposure_s=first_s + i + 0.25,
        )
        for i in range(n)
    )


def test_every_record_is_there_once_and_can_be_named() -> None:
    first, second = records(1), records(2)
    merged = merge_records([RunPart("ONE", (7, 9), first), RunPart("TWO", (9, 7), second)], (7, 9), 60.0)
    assert [len(part) for part in merged] == [3, 3]
    together = [record for part in merged for record in part]
    assert [record.index for record in together] == [0, 1, 2, 3, 4, 5]
    assert [record.label for record in together[2:4]] == ["ONE/20 stamp2", "TWO/0 stamp0"]
    for new, old in zip(together, first + second, strict=True):
        assert (new.reject_reason, new.detail) == (old.reject_reason, old.detail)
        np.testing.assert_array_equal(new.theta_rad, old.theta_rad)
        assert new.star_intensity == old.star_intensity
    # the second run had its facets in the other order
    np.testing.assert_array_equal(together[0].facet_intensity, first[0].facet_intensity)
    np.testing.assert_array_equal(together[3].facet_intensity, second[0].facet_intensity[::-1])
    np.testing.assert_array_equal(together[3].facet_saturated_share, [0.9, 0.7])


def test_times_grow_through_all_runs() -> None:
    parts = [RunPart(str(k), (7, 9), records(k, first_s=start_s)) for k, start_s in enumerate([5.0, 0.0, -1e6, 3.0])]
    merged = merge_records(parts, (7, 9), 60.0)
    star_s = np.array([record.star_mid_exposure_s for part in merged for record in part])
    differences_s = np.array([record.mid_exposure_difference_s for part in merged for record in part])
    assert star_s[0] == 5.0
    np.testing.assert_allclose(np.diff(star_s)[[2, 5, 8]], 60.25)  # from the later camera's last exposure on
    np.testing.assert_allclose(np.delete(np.diff(star_s), [2, 5, 8]), 1.0)
    np.testing.assert_allclose(differences_s, 0.25)


def test_runs_without_times_or_records_do_not_disturb_others() -> None:
    timeless = tuple(records(3, first_s=np.nan))
    parts = [RunPart("A", (7, 9), timeless), RunPart("B", (7, 9), ()), RunPart("C", (7, 9), records(4, first_s=2.0))]
    merged = merge_records(parts, (7, 9), 60.0)
    assert np.isnan([record.star_mid_exposure_s for record in merged[0]]).all()
    assert merged[1] == []
    assert [record.star_mid_exposure_s for record in merged[2]] == [2.0, 3.0, 4.0]
    assert [record.index for record in merged[2]] == [3, 4, 5]


def test_a_copy_is_refused_by_its_records() -> None:
    more = records(1, n=5)
    with pytest.raises(ConfigError, match=r"TWO: 4 of its 5 records are in ONE .*record 0 is record 0"):
        merge_records([RunPart("ONE", (7, 9), more), RunPart("TWO", (7, 9), more)], (7, 9), 60.0)


def test_dark_records_at_one_place_are_no_copies() -> None:
    dark = [tuple(records(1)) for _ in range(2)]
    for record in dark[0] + dark[1]:
        record.facet_intensity[:] = 0.0
    merged = merge_records([RunPart("ONE", (7, 9), dark[0]), RunPart("TWO", (7, 9), dark[1])], (7, 9), 60.0)
    assert sum(map(len, merged)) == 6
