"""What `align --resume` does with a campaign in every state in which it may be found."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from campaign_lives import CONFIG, Life, Nursery, begin
from typer.testing import CliRunner

from namod_ctl.app.build.twin_campaign import WORLD_FILE
from namod_ctl.app.cli import app
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import TRANSITION

PATIENCE_S = 60.0
MANUAL = CONFIG[: CONFIG.index("[actuators]")].replace("backlash_um = 10.0", "backlash_um = 0.0")


def wait_until(is_so: Callable[[], bool], life: Life, nursery: Nursery) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert not life.has_ended(), nursery.printed()
        assert time.monotonic() < deadline_s
        time.sleep(0.01)  # for another process there is nothing to wait on but its files


def live_until(state: str, life: Life, path: Path, nursery: Nursery) -> Life:
    """The life, when the journal shows that state."""
    wait_until(lambda: (path / WORLD_FILE).exists() and journal(path)[-1:] == [state], life, nursery)
    return life


def journal(path: Path) -> list[str]:
    """All states that the campaign went to."""
    with CampaignStore.open(path) as store:
        return [str(event.data["to"]) for event in store.events() if event.kind == TRANSITION]


def elsewhere(*arguments: str | Path) -> tuple[int, str]:
    """Exit code and output of a command in another terminal."""
    result = CliRunner().invoke(app, list(map(str, arguments)))
    return result.exit_code, result.output


def resume(path: Path, *more: str) -> tuple[str, ...]:
    return ("align", "--resume", str(path), *more)


def test_converged_is_said_and_nothing_is_done(nursery: Nursery, tmp_path: Path) -> None:
    path, command = begin(tmp_path)
    assert nursery.run(*command) == 0, nursery.printed()
    states, world = journal(path), (path / WORLD_FILE).read_bytes()
    n_before = len(nursery.printed())
    assert nursery.run(*resume(path)) == 0
    assert "has converged" in nursery.printed()[n_before:]
    assert "nothing to do" in nursery.printed()[n_before:]
    assert (journal(path), (path / WORLD_FILE).read_bytes()) == (states, world)


def test_failed_is_said_and_nothing_is_done(nursery: Nursery, tmp_path: Path) -> None:
    path, command = begin(tmp_path)
    live_until("recording", nursery.begin(*command), path, nursery).kill()
    with CampaignStore.open(path, read_only=False) as store:
        store.add_transition("recording", "failed", "fail", "both cameras are broken")
    n_before = len(nursery.printed())
    assert nursery.run(*resume(path)) == 2
    assert "is failed: both cameras are broken" in nursery.printed()[n_before:]
    assert journal(path)[-1] == "failed"


def test_held_wants_a_release_first(nursery: Nursery, tmp_path: Path) -> None:
    path, command = begin(tmp_path)
    life = live_until("recording", nursery.begin(*command), path, nursery)
    os.kill(life.pid, signal.SIGTERM)
    assert life.exit_code() != 0
    assert journal(path)[-1] == "held"
    n_before = len(nursery.printed())
    assert nursery.run(*resume(path)) == 2
    assert f"namod-ctl release {path}" in nursery.printed()[n_before:]
    assert journal(path)[-1] == "held"
    assert elsewhere("release", path)[0] == 0
    assert nursery.run(*resume(path)) == 0, nursery.printed()
    assert journal(path)[-1] == "converged"


def test_paused_stays_paused_until_somebody_resumes(nursery: Nursery, tmp_path: Path) -> None:
    path, command = begin(tmp_path)
    live = live_until("recording", nursery.begin(*command), path, nursery)
    assert elsewhere("pause", path)[0] == 0
    live_until("paused", live, path, nursery).kill()
    size = (path / WORLD_FILE).stat().st_size
    life = nursery.begin(*resume(path))
    wait_until(lambda: (path / WORLD_FILE).stat().st_size > size, life, nursery)
    assert elsewhere("resume", path)[0] == 0
    assert life.exit_code() == 0, nursery.printed()
    assert journal(path)[-1] == "converged"
    assert journal(path).count("paused") == 1


def test_killed_while_a_person_was_asked_asks_again(nursery: Nursery, tmp_path: Path) -> None:
    """The wish to be asked is kept over the restart; a `no` is held, and nothing has moved."""
    path, command = begin(tmp_path, "--approve", "ask")
    live_until("awaiting_approval", nursery.begin(*command), path, nursery).kill()
    assert elsewhere("approve", path)[0] == 2  # nobody runs who could have shown it
    n_before = len(journal(path))
    life = nursery.begin(*resume(path))
    wait_until(lambda: journal(path)[n_before:] == ["previewing", "awaiting_approval"], life, nursery)
    assert elsewhere("refuse", path)[0] == 0
    assert life.exit_code() == 3
    assert journal(path)[-1] == "held"
    with CampaignStore.open(path) as store:
        assert store.orders() == []
    assert elsewhere("release", path)[0] == 0
    life = live_until("awaiting_approval", nursery.begin(*resume(path)), path, nursery)
    assert elsewhere("approve", path)[0] == 0
    assert life.exit_code() == 0, nursery.printed()
    assert journal(path)[-1] == "converged"


def test_killed_while_people_turn_bolts_waits_for_the_rest(nursery: Nursery, tmp_path: Path) -> None:
    """What was marked before the kill, while nobody ran, and afterwards: every facet is turned, and once."""
    path, command = begin(tmp_path, config_text=MANUAL)
    live = live_until("awaiting_operator", nursery.begin(*command), path, nursery)
    code, text = elsewhere("done", path, "--facet", "1,2")
    assert (code, "2 facets marked" in text, "to go: 3, 4, 5, 6" in text) == (0, True, True), text
    live.kill()
    code, text = elsewhere("done", path, "--facet", "4")
    assert (code, "3, 5, 6" in text) == (0, True), text
    n_before = len(nursery.printed())
    size = (path / WORLD_FILE).stat().st_size
    life = nursery.begin(*resume(path))
    wait_until(lambda: (path / WORLD_FILE).stat().st_size > size, life, nursery)
    wait_until(lambda: "3 to go: 3, 5, 6" in nursery.printed()[n_before:], life, nursery)
    assert "instructions.pdf" in nursery.printed()[n_before:]
    assert elsewhere("done", path, "--all")[0] == 0
    assert life.exit_code() == 0, nursery.printed()
    assert journal(path)[-1] == "converged"
    assert "6 of 6 facets were turned as asked" in nursery.printed()[n_before:]
