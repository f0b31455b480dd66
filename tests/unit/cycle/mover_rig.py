"""Two buses of fake drives under a mover."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fake_drives import SPEED_M_PER_S, FakeBus, FakeDrive, TestClock

from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.cycle.mover import Mover

SETTINGS = MotionSettings(
    max_travel_per_cycle_m=mm_to_m(2.0),
    approach_m=um_to_m(30.0),
    arrival_tolerance_m=um_to_m(6.0),
    settle_s=0.1,
    poll_s=0.05,
    speed_m_per_s=SPEED_M_PER_S,
)
STOPPED_WITHIN_S = 0.5


class Rig:
    """Facets of two legs; facets 1-3 on bus A, 4-6 on bus B."""

    def __init__(self, max_moving: int = 3) -> None:
        self.clock = TestClock()
        self.switch = StopSwitch()
        self.drives = {
            Leg(facet, index): FakeDrive(self.clock, f"drive {facet}.{index + 1}")
            for facet in range(1, 7)
            for index in range(2)
        }
        self.buses = [
            FakeBus(name, {leg: drive for leg, drive in self.drives.items() if leg.facet_id in facets}, max_moving)
            for name, facets in (("A", (1, 2, 3)), ("B", (4, 5, 6)))
        ]
        self.mover = Mover(self.buses, self.clock, SETTINGS, self.switch)
        self.told: list[MoveResult] = []

    def orders(self, target_m: float = mm_to_m(1.0), legs: Sequence[Leg] | None = None) -> list[MoveOrder]:
        return [MoveOrder(leg, 0.0, target_m) for leg in legs or self.drives]

    def execute(
        self, orders: list[MoveOrder] | None = None, while_waiting: Callable[[], None] = lambda: None
    ) -> dict[Leg, MoveResult]:
        orders = self.orders() if orders is None else orders
        results = self.mover.execute(orders, self.told.append, while_waiting)
        assert [result.order for result in results] == orders
        assert sorted(map(str, self.told)) == sorted(map(str, results))  # each one was told, once
        return {result.order.leg: result for result in results}

    def assert_all_stand(self, thrown_s: float) -> None:
        for drive in self.drives.values():
            assert not drive.moves_at(thrown_s + STOPPED_WITHIN_S), drive.name
            assert all(time_s <= thrown_s for time_s, order, _ in drive.orders if order == "move")

    def outcomes(self, results: dict[Leg, MoveResult]) -> dict[MoveOutcome, set[Leg]]:
        return {
            outcome: {leg for leg, result in results.items() if result.outcome is outcome}
            for outcome in {result.outcome for result in results.values()}
        }
