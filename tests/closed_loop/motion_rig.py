"""The twin's drives on their lines, the product's drivers on the other ends, and a mover on top."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from namod_ctl.app.build.actuators import build_motion_settings
from namod_ctl.app.build.twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.cycle.mover import Mover
from namod_ctl.devices.buses import DriveBus
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.settings import FaultSpec

SEED = 4
FACETS = {"south": (3, 4, 5), "north": (19, 21, 22)}
"""Of the built-in configs of FACT, all with two lines."""
N_MOVING = 6


@dataclass
class MotionRig:
    clock: MonotonicClock
    drives: TwinDrives
    buses: list[DriveBus]
    settings: MotionSettings
    switch: StopSwitch
    mover: Mover
    told: list[MoveResult] = field(default_factory=list)

    @property
    def south(self) -> set[Leg]:
        return {leg for leg in self.drives.legs if leg.facet_id in FACETS["south"]}

    @property
    def north(self) -> set[Leg]:
        return set(self.drives.legs) - self.south

    def inject(self, name: str, start_s: float = 0.0, duration_s: float | None = None, **params: float | str) -> None:
        self.drives.inject(FaultSpec(name, start_s, duration_s, params))

    def readbacks_m(self) -> dict[Leg, float]:
        found = {}
        for leg, state in self.mover.read_states().items():
            assert isinstance(state, DriveState), state
            found[leg] = state.position_m
        return found

    def orders(self, travel_m: float, legs: Sequence[Leg] | None = None) -> list[MoveOrder]:
        return [
            MoveOrder(leg, at_m, at_m + travel_m)
            for leg, at_m in self.readbacks_m().items()
            if legs is None or leg in legs
        ]

    def execute(
        self, orders: Sequence[MoveOrder], while_waiting: Callable[[], None] = lambda: None
    ) -> dict[Leg, MoveResult]:
        return {result.order.leg: result for result in self.mover.execute(orders, self.told.append, while_waiting)}

    def n_moving(self) -> int:
        return sum(self.drives.motor(leg).is_moving for leg in self.drives.legs)

    def moves_of(self, leg: Leg) -> list[float]:
        """Ends of all moves that the drive itself says it was ordered."""
        return [entry.end_m for entry in self.drives.log if entry.leg == leg and entry.order == "move"]


def legs_by_outcome(results: dict[Leg, MoveResult]) -> dict[MoveOutcome, set[Leg]]:
    found: dict[MoveOutcome, set[Leg]] = {}
    for leg, result in results.items():
        found.setdefault(result.outcome, set()).add(leg)
    return found


def small_config(name: str, *, in_memory: bool = True) -> InstrumentConfig:
    """A built-in config with three facets on each of its two lines."""
    config = load_config(name)
    assert config.actuators is not None
    buses = [
        bus.model_copy(
            update={"facet_ids": facets, "max_moving": N_MOVING, "name": line}
            | ({"url": f"loopback://{line}"} if in_memory else {})
        )
        for bus, (line, facets) in zip(config.actuators.buses[:2], FACETS.items(), strict=True)
    ]
    return config.model_copy(update={"actuators": config.actuators.model_copy(update={"buses": tuple(buses)})})


@contextmanager
def motion_rig(
    name: str = "fact_actuated", *, in_memory: bool = True, clock: MonotonicClock | None = None
) -> Iterator[MotionRig]:
    """`clock` None: the twin's own, which passes when somebody waits."""
    config = small_config(name, in_memory=in_memory)
    clock, switch = clock or ManualClock(), StopSwitch()
    drives = TwinDrives(twin_wiring(config), clock, FaultPlan(), SEED)
    with build_twin_actuators(config, drives) as buses:
        settings = build_motion_settings(config)
        yield MotionRig(clock, drives, buses, settings, switch, Mover(buses, clock, settings, switch))
