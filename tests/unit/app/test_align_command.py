"""`namod-ctl align` as a person calls it: which frames its recordings keep."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from namod_ctl.app.commands.align import align
from namod_ctl.app.views.align_view import AlignView
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.progress import Progress
from namod_ctl.store.live_pictures import live_pictures
from namod_ctl.store.run import RunStore

app = typer.Typer()
app.command()(align)


@pytest.mark.parametrize("keep", ["all", None])
def test_frames_are_kept_as_wished_and_pictures_shown_in_any_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: str | None
) -> None:
    def interrupt(view: AlignView, cycle: int, progress: Progress) -> None:
        if progress.n_accepted >= 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(AlignView, "recording", interrupt)
    arguments = ["--config", "mini_fact", "--out", str(tmp_path / "CAMPAIGN"), "--records", "50"]
    CliRunner().invoke(app, arguments + ([] if keep is None else ["--keep-frames", keep]))
    run = tmp_path / "CAMPAIGN" / "cycle_01"
    with RunStore.open(run) as store:
        indices = {record.index for record in store.records()}
        kept = set(store.frame_files("star_camera"))
        status = LiveStatus.from_json(store.note(NOTE_LIVE) or "")
    assert len(indices) >= 3
    assert kept == (indices if keep else set())
    assert set(live_pictures(run)) == (set() if keep else {"star_camera", "reflector_camera"})
    assert status is not None
    assert status.n_wanted == 50
