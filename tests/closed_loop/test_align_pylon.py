"""A whole campaign through Basler's own library: emulated cameras see the twin's sky, drives answer over Modbus TCP.

The criteria are those of campaigns on the twin alone (`test_campaign_faults`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from campaign_rig import N_RECORDS, campaign_rig

from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.motion import MoveOutcome

pytest.importorskip("pypylon.pylon", reason="pypylon is not installed: pip install 'namod-ctl[pylon]'")

from namod_ctl.devices.cameras.pylon_camera import PylonCamera
from namod_ctl.twin.camera import TwinCamera

ALIGNED = 1.05
"""Of the limit, and less: as good as a campaign on the twin alone gets on so few records."""


@pytest.fixture
def delivered(monkeypatch: pytest.MonkeyPatch) -> dict[type, list[bytes]]:
    """Fingerprints of all frames that cameras of each kind delivered."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    found: dict[type, list[bytes]] = defaultdict(list)
    for kind in (TwinCamera, PylonCamera):

        def fetch(self: Any, timeout_s: float, kind: type = kind, original: Any = kind.fetch) -> Exposure:
            exposure: Exposure = original(self, timeout_s)
            found[kind].append(sha256(exposure.image.tobytes()).digest())
            return exposure

        monkeypatch.setattr(kind, "fetch", fetch)
    return found


def test_a_campaign_converges_through_the_makers_library(tmp_path: Path, delivered: dict[type, list[bytes]]) -> None:
    with campaign_rig(tmp_path / "campaign", name="bench_pylon", in_memory=False) as rig:
        assert rig.run() == "converged", rig.reason()
        rig.assert_safe()
        rig.assert_only_ordered_moves()
        assert rig.ratio_to_limit < ALIGNED
        assert rig.outcomes().keys() == {MoveOutcome.ARRIVED}
        assert not rig.findings()
        n_recordings = len(rig.store.cycles())
    # what the library delivered is what the twin saw, to the last bit, and nothing went past it but the last frames of
    # recordings, which close their cameras while the next pair is exposed
    came, seen = Counter(delivered[PylonCamera]), Counter(delivered[TwinCamera])
    assert came.total() > 2 * n_recordings * N_RECORDS
    assert not came - seen
    assert (seen - came).total() <= 2 * n_recordings
