"""The catalogue of faults: one name each, injected by one call, described by data."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from types import MappingProxyType

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.twin.settings import FaultSpec, Limits

Value = float | str


@dataclass(frozen=True, slots=True)
class FaultKind:
    """What a fault does, for people, and its parameters with their defaults.

    `limits` are those of parameters whose limits differ from those of `LIMITS`.
    """

    description: str
    defaults: Mapping[str, Value]
    limits: Mapping[str, Limits] = field(default_factory=lambda: MappingProxyType({}))

    def limits_of(self, key: str) -> Limits | None:
        """Of a parameter that is a number; None for one that is a name."""
        return None if isinstance(self.defaults[key], str) else self.limits.get(key) or LIMITS[key]


@dataclass(frozen=True, slots=True)
class Fault:
    """One injected fault.

    Attributes
    ----------
    number
        Which of all injected faults this is; seeds what is random in it.
    end_s
        Infinite for a fault that stays.
    """

    name: str
    number: int
    start_s: float
    end_s: float
    params: Mapping[str, Value]

    def is_active(self, time_s: float) -> bool:
        """Does the fault last at `time_s`?"""
        return self.start_s <= time_s < self.end_s

    def touches(self, start_s: float, end_s: float) -> bool:
        """Does the fault last at any moment from `start_s` to `end_s`?"""
        return self.start_s < end_s and start_s < self.end_s

    def value(self, name: str) -> float:
        """A parameter that is a number."""
        return float(self.params[name])

    def concerns(self, camera: str) -> bool:
        """Is it a fault of this camera, "star" or "reflector"?"""
        return self.params.get("camera", camera) in (camera, "both")

    def concerns_leg(self, leg: Leg) -> bool:
        """Is it a fault of this leg?"""
        return self.value("facet") in (leg.facet_id, EVERY_FACET) and self.value("leg") in (leg.index + 1, EVERY_LEG)

    def concerns_bus(self, bus: str) -> bool:
        """Is it a fault of this bus?"""
        return self.params["bus"] in (bus, EVERY_BUS)


EVERY_FACET, EVERY_LEG, EVERY_BUS = -1.0, 0.0, ""
"""Legs are counted from 1 in faults, as people count them."""
NO_FACET = -1.0
WHOM: Mapping[str, Value] = {"facet": EVERY_FACET, "leg": EVERY_LEG}
PAIR: Mapping[str, Value] = {"facet": NO_FACET, "leg": 1.0, "other_facet": NO_FACET, "other_leg": 1.0}

_ANY_DIRECTION = Limits(deg_to_rad(-10.0), deg_to_rad(10.0))
_YES_OR_NO = Limits(0.0, 1.0)
LIMITS: Mapping[str, Limits] = {
    "share": Limits(0.0, 1.0),
    "factor": Limits(0.0, 100.0),
    "count": Limits(0.0, 1000.0),
    "delay_s": Limits(0.0, 60.0),
    "facet": Limits(-1.0, 1e6),
    "other_facet": Limits(-1.0, 1e6),
    "leg": Limits(0.0, 6.0),
    "other_leg": Limits(0.0, 6.0),
    "end": Limits(-1.0, 1.0),
    "is_in_move": _YES_OR_NO,
    "is_reported": _YES_OR_NO,
    "period_s": Limits(1.0, 1e6),
    "offset_x_rad": _ANY_DIRECTION,
    "offset_y_rad": _ANY_DIRECTION,
    "miss_rad": _ANY_DIRECTION,
    "x_rad": _ANY_DIRECTION,
    "y_rad": _ANY_DIRECTION,
    "fainter_mag": Limits(-10.0, 20.0),
    "magnitude": Limits(-15.0, 20.0),
    "angle_rad": Limits(-math.tau, math.tau),
    "speed_rad_per_s": Limits(0.0, deg_to_rad(90.0)),
    "blink_s": Limits(0.01, 60.0),
    "level_share": Limits(0.0, 10.0),
    "gradient_share": Limits(0.0, 10.0),
    "rise_s": Limits(10.0, 1e6),
    "decay_s": Limits(1.0, 1e6),
    "floor": Limits(0.0, 1.0),
    "adu_per_s": Limits(0.0, 1e6),
    "by_s": Limits(-1e7, 1e7),
}
"""Of the parameters of all faults, by name."""

DRIVE_CATALOGUE: Mapping[str, FaultKind] = {
    "bit_errors": FaultKind("bits flip on a line, both ways: in a `share` of all bytes", {"bus": "", "share": 0.003}),
    "line_noise": FaultKind(
        "up to `count` bytes that nobody sent stand before a `share` of the answers",
        {"bus": "", "share": 0.3, "count": 5.0},
    ),
    "lost_answers": FaultKind("a `share` of the answers gets lost; the drives act", {"bus": "", "share": 0.2}),
    "lost_requests": FaultKind("a `share` of the requests gets lost on its way", {"bus": "", "share": 0.2}),
    "slow_answers": FaultKind(
        "a `share` of the answers comes `delay_s` late; in memory: together with the next one",
        {"bus": "", "share": 1.0, "delay_s": 0.5},
    ),
    "bus_unplugged": FaultKind("a line is pulled out, and plugged in again when the fault ends", {"bus": ""}),
    "drive_reset": FaultKind(
        "a drive loses power for a moment: stops, forgets its position and its settings; is_in_move = 1: half way "
        "through its next move, 0: when the fault begins",
        {**WHOM, "is_in_move": 1.0},
    ),
    "stuck_leg": FaultKind("a spindle is jammed: the motor counts, nothing moves", WHOM),
    "lost_steps": FaultKind("a motor loses a `share` of its steps", {**WHOM, "share": 0.3}),
    "backlash_grown": FaultKind("the play between motor and leg grows by `factor`", {**WHOM, "factor": 3.0}),
    "limit_switch": FaultKind(
        "a limit switch reports the end of the way; end = -1 the lower, 1 the upper", {**WHOM, "end": 1.0}
    ),
    "supply_sag": FaultKind(
        "more than `count` drives that move at once on a bus all lose a `share` of their steps",
        {"bus": "", "count": 4.0, "share": 0.4},
    ),
    "wrong_sign": FaultKind("a leg is wired the wrong way round", {"facet": NO_FACET, "leg": 1.0}),
    "wrong_scale": FaultKind(
        "a leg travels `factor` times what its config says: another pitch or gear", {**WHOM, "factor": 2.0}
    ),
    "swapped_addresses": FaultKind("two drives have each other's addresses", PAIR),
    "wrong_facet": FaultKind(
        "two facets are wired to each other's drives, leg by leg", {"facet": NO_FACET, "other_facet": NO_FACET}
    ),
    "same_address": FaultKind(
        "a drive has the address of another one too, not its own: both do what is asked of the other", PAIR
    ),
}
"""Of drives, their lines and their wiring; `drives.TwinDrives.refuse` checks that what they name exists."""

CATALOGUE: Mapping[str, FaultKind] = {
    "clouds": FaultKind(
        "clouds drift by: the light falls by up to `factor`, smoothly, over and over within `period_s`",
        {"factor": 30.0, "period_s": 60.0},
        {"factor": Limits(1.0, 1e6)},
    ),
    "clouds_total": FaultKind("an opaque cloud: no light of any star", {}),
    "second_star": FaultKind(
        "another star in the field, at an offset from the reference star",
        {"offset_x_rad": deg_to_rad(0.25), "offset_y_rad": deg_to_rad(0.1), "fainter_mag": 0.5},
    ),
    "satellite": FaultKind(
        "a satellite draws a streak through the field, once, at the fault's start",
        {"speed_rad_per_s": deg_to_rad(0.6), "angle_rad": 0.5, "miss_rad": deg_to_rad(0.1), "magnitude": -1.0},
    ),
    "aircraft": FaultKind(
        "an aircraft crosses the field with a steady and a blinking light",
        {
            "speed_rad_per_s": deg_to_rad(1.5),
            "angle_rad": 2.0,
            "miss_rad": deg_to_rad(0.15),
            "magnitude": -3.5,
            "blink_s": 0.25,
        },
    ),
    "moonlight": FaultKind(
        "the moon lights sky and scene, stronger to one side; shares of a magnitude 0 star's brightest pixel",
        {"level_share": 0.006, "gradient_share": 0.006, "angle_rad": 0.8},
    ),
    "twilight": FaultKind(
        "the sky brightens: by e every `rise_s`, from `level_share` of a magnitude 0 star's brightest pixel",
        {"level_share": 0.002, "rise_s": 120.0},
    ),
    "dew": FaultKind(
        "dew on a lens (camera = star, reflector or both): its light decays with `decay_s` down to `floor`",
        {"camera": "reflector", "decay_s": 600.0, "floor": 0.3},
    ),
    "dropped_frame": FaultKind("frames get lost on their way, a `share` of them", {"camera": "both", "share": 1.0}),
    "torn_frame": FaultKind(
        "frames arrive incomplete; is_reported = 0: the camera does not notice and delivers a torn image",
        {"camera": "both", "share": 1.0, "is_reported": 1.0},
    ),
    "hot_pixels": FaultKind(
        "more hot pixels",
        {"camera": "both", "count": 3000.0, "adu_per_s": 400.0},
        {"count": Limits(0.0, 1e6)},
    ),
    "telescope_jump": FaultKind(
        "the telescope jumps by this much and stays there until the fault ends",
        {"x_rad": deg_to_rad(0.15), "y_rad": deg_to_rad(-0.1)},
    ),
    "clock_set_back": FaultKind("somebody sets the computer's wall clock back", {"by_s": 3600.0}),
    "camera_lost": FaultKind("a camera does not answer any more", {"camera": "reflector"}),
    **DRIVE_CATALOGUE,
}


class FaultPlan:
    """All injected faults of one twin."""

    def __init__(self) -> None:
        self._faults: tuple[Fault, ...] = ()
        self._names: frozenset[str] = frozenset()

    def inject(self, spec: FaultSpec) -> Fault:
        """Add a fault.

        Raises
        ------
        ConfigError
            No such fault or parameter, or a value of the wrong kind; it names what there is.
        """
        kind = CATALOGUE.get(spec.name)
        if kind is None:
            raise ConfigError(f"there is no fault {spec.name!r}; there are: {', '.join(CATALOGUE)}")
        for key, value in spec.params.items():
            if key not in kind.defaults:
                known = ", ".join(kind.defaults) or "none"
                raise ConfigError(f"fault {spec.name!r} has no parameter {key!r}; its parameters: {known}")
            _refuse_wrong_value(spec.name, key, value, kind)
        duration_s = math.inf if spec.duration_s is None else spec.duration_s
        if not (spec.start_s >= 0.0 and duration_s > 0.0):
            raise ConfigError(
                f"fault {spec.name!r}: start_s = {spec.start_s:g}, duration_s = {duration_s:g}; "
                "the start must not be negative, the duration positive"
            )
        params = {**kind.defaults, **spec.params}
        fault = Fault(spec.name, len(self._faults), spec.start_s, spec.start_s + duration_s, params)
        self._faults = (*self._faults, fault)
        self._names |= {fault.name}
        return fault

    def has_any(self, names: AbstractSet[str]) -> bool:
        """Has any fault of these names been injected, whenever it happens?"""
        return not self._names.isdisjoint(names)

    def of(self, name: str) -> list[Fault]:
        """All faults of that name, whenever they happen."""
        return [fault for fault in self._faults if fault.name == name]

    def active(self, name: str, time_s: float, camera: str = "both") -> list[Fault]:
        """The faults of that name (and camera) that last at `time_s`."""
        return [fault for fault in self.of(name) if fault.is_active(time_s) and fault.concerns(camera)]

    def next_change_s(self, names: Container[str], after_s: float, until_s: float) -> float:
        """The first moment after `after_s` at which a fault of these names begins or ends; at latest `until_s`."""
        moments = (moment for fault in self._faults if fault.name in names for moment in (fault.start_s, fault.end_s))
        return min((moment for moment in moments if after_s < moment < until_s), default=until_s)

    def wall_clock_error_s(self, time_s: float) -> float:
        """By how much the wall clock is wrong."""
        return -sum(fault.value("by_s") for fault in self.active("clock_set_back", time_s))


def _refuse_wrong_value(fault: str, key: str, value: Value, kind: FaultKind) -> None:
    where, limits = f"fault {fault!r}: {key} = {value!r}", kind.limits_of(key)
    if key == "bus":
        if not isinstance(value, str):
            raise ConfigError(f"{where}; it must be the name of a bus, or '' for all")
    elif limits is None:
        if value not in ("star", "reflector", "both"):
            raise ConfigError(f"{where}; it must be 'star', 'reflector' or 'both'")
    elif isinstance(value, str) or not math.isfinite(value):
        raise ConfigError(f"{where}; it must be a finite number")
    elif not limits.least <= value <= limits.most:
        raise ConfigError(f"{where}; it must be from {limits.least:g} to {limits.most:g}")
