"""A measurement that says "worse" is confirmed by a longer look before a correction is taken back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from campaign_rig import N_RECORDS, CampaignRig, campaign_rig

from namod_ctl.cycle import campaign
from namod_ctl.cycle.convergence import Decision, Measurement, decide


def deceived(monkeypatch: pytest.MonkeyPatch, path: Path, n_deceptions: int) -> tuple[CampaignRig, str]:
    """A campaign whose first measurements after the correction are taken for worse, so many times."""
    left = [n_deceptions]

    def misjudge(history: Sequence[Measurement], limit: float | None, max_cycles: int) -> tuple[Decision, str]:
        if len(history) > 1 and left[0]:
            left[0] -= 1
            return Decision.WORSE, "it looks worse"
        return decide(history, limit, max_cycles)

    monkeypatch.setattr(campaign, "decide", misjudge)
    with campaign_rig(path) as rig:
        state = rig.run()
        n_undone = sum(event.data.get("trigger") == "undo" for event in rig.store.events())
        assert n_undone == (n_deceptions > 1), rig.reason()
        assert rig.store.cycles()[1].n_records >= 2 * N_RECORDS
        rig.assert_safe()
        return rig, state


def test_what_a_longer_look_does_not_confirm_is_not_undone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rig, state = deceived(monkeypatch, tmp_path / "campaign", 1)
    assert state == "converged"
    assert rig.ratio_to_limit < 1.05


def test_what_it_confirms_is_undone_once_and_held(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _, state = deceived(monkeypatch, tmp_path / "campaign", 2)
    assert state == "held"
