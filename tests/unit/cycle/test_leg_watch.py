"""What the mover shows of its drives while it moves them: what they say anyway, rarely enough, and to the last."""

from __future__ import annotations

import inspect
import math
import threading
from collections import Counter
from collections.abc import Mapping

import pytest
from mover_rig import SETTINGS, Rig

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import mm_to_m
from namod_ctl.cycle import leg_watch
from namod_ctl.cycle.leg_watch import SHOW_EVERY_S, Heard, LegWatch, WatchedDrive
from namod_ctl.cycle.mover import Mover


class Screen:
    """What was shown, in order, and by which thread."""

    def __init__(self) -> None:
        self.shown: list[dict[Leg, Heard]] = []
        self.threads: set[int] = set()

    def __call__(self, heard: Mapping[Leg, Heard]) -> None:
        self.shown.append(dict(heard))
        self.threads.add(threading.get_ident())

    @property
    def last(self) -> dict[Leg, Heard]:
        return {leg: said for heard in self.shown for leg, said in heard.items()}


def rig_with(screen: Screen) -> Rig:
    rig = Rig()
    rig.mover = Mover(rig.buses, rig.clock, SETTINGS, rig.switch, screen)
    return rig


def test_at_the_end_it_shows_where_every_leg_stands() -> None:
    screen = Screen()
    rig = rig_with(screen)
    results = rig.execute()
    assert {result.outcome for result in results.values()} == {MoveOutcome.ARRIVED}
    assert set(screen.last) == set(rig.drives)
    for leg, said in screen.last.items():
        assert isinstance(said, DriveState)
        assert (said.position_m, said.is_moving) == (results[leg].readback_m, False)
    assert screen.threads == {threading.get_ident()}


def test_on_the_way_it_shows_legs_that_move(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leg_watch, "SHOW_EVERY_S", 0.0)
    screen = Screen()
    rig_with(screen).execute()
    on_the_way = [
        said.position_m
        for heard in screen.shown
        for said in heard.values()
        if isinstance(said, DriveState) and said.is_moving
    ]
    assert any(0.0 < position_m < mm_to_m(1.0) for position_m in on_the_way)


def test_no_drive_is_asked_for_it() -> None:
    def questions(rig: Rig) -> Counter[str]:
        asked: Counter[str] = Counter()
        for drive in rig.drives.values():
            drive.on_question = lambda name=drive.name: asked.update([name])  # type: ignore[misc]
        rig.execute(rig.orders(legs=[Leg(1, 0), Leg(1, 1)]))  # one bus: how often is then no matter of chance
        return asked

    assert questions(rig_with(Screen())) == questions(Rig())


def test_a_silent_drive_and_a_faulty_one_are_shown_as_such() -> None:
    screen = Screen()
    rig = rig_with(screen)
    rig.drives[Leg(2, 1)].silent_s = (0.0, math.inf)
    rig.drives[Leg(5, 0)].faults = ("overtemperature",)
    rig.mover.read_states()
    silent, faulty = screen.last[Leg(2, 1)], screen.last[Leg(5, 0)]
    assert isinstance(silent, str)
    assert "no answer" in silent
    assert isinstance(faulty, DriveState)
    assert faulty.faults == ("overtemperature",)


def test_a_stop_shows_where_everything_stands() -> None:
    screen = Screen()
    rig = rig_with(screen)
    for drive in rig.drives.values():
        drive.start_move(mm_to_m(1.0))
    rig.clock.wait_s(0.3)
    rig.mover.stop_all("a test")
    positions = [
        said.position_m for said in screen.last.values() if isinstance(said, DriveState) and not said.is_moving
    ]
    assert positions == pytest.approx([mm_to_m(0.3)] * len(rig.drives), rel=0.2)


def test_it_shows_at_most_twice_a_second_and_keeps_the_newest() -> None:
    now_s, screen, leg = [0.0], Screen(), Leg(1, 0)
    watch = LegWatch(screen, lambda: now_s[0])
    for tick in range(1000):
        now_s[0] = 0.01 * tick
        watch.hear(leg, DriveState(float(tick), True, True))
        watch.show()
    assert len(screen.shown) == pytest.approx(10.0 / SHOW_EVERY_S, abs=1)
    watch.show(now=True)
    assert screen.last[leg] == DriveState(999.0, True, True)
    n_shown = len(screen.shown)
    now_s[0] += 10.0
    watch.show()
    assert len(screen.shown) == n_shown  # nothing new


def test_a_watched_drive_does_all_that_a_drive_does() -> None:
    rig = Rig()
    drive = rig.drives[Leg(1, 0)]
    watched: Drive = WatchedDrive(Leg(1, 0), drive, LegWatch(Screen()))
    assert (watched.name, watched.range_m, watched.resolution_m) == (drive.name, drive.range_m, drive.resolution_m)
    assert watched.identity() == drive.identity()
    watched.start_move(mm_to_m(0.5))
    rig.clock.wait_s(0.1)
    watched.stop()
    watched.start_homing()
    assert [order for _, order, _ in drive.orders] == ["move", "stop", "home"]
    drive.faults = ("a fault",)
    watched.clear_faults()
    assert not watched.state().faults
    asked = {name for name, _ in inspect.getmembers(Drive) if not name.startswith("_")}
    assert asked <= {name for name, _ in inspect.getmembers(WatchedDrive)}
