"""What the section `[actuators]` of an instrument's config may say: buses, their drives, and how legs are moved."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, field_validator, model_validator

from namod_ctl.app.config.section import FacetId, FileName, Section, within

ProtocolName = Literal["tmcl", "zaber", "modbus_rtu", "modbus_tcp"]
MODBUS = ("modbus_rtu", "modbus_tcp")
FACTORY_BAUD = {"tmcl": 9600, "zaber": 115_200, "modbus_rtu": 19_200, "modbus_tcp": 19_200}
"""What drives are shipped with (manuals of Trinamic and Zaber; Modbus over Serial Line V1.02, 2.4.1); idle with TCP."""
ADDRESSES = {"tmcl": (1, 255), "zaber": (1, 99), "modbus_rtu": (1, 247), "modbus_tcp": (1, 247)}
AXES = {"tmcl": (0, 5), "zaber": (1, 9), "modbus_rtu": (0, 0), "modbus_tcp": (0, 0)}
"""As each protocol counts them: motors of a TMCL module, axes of a Zaber device; a Modbus unit is one drive."""

LOOPBACK = "loopback://"
SOCKET = "socket://"
NETWORK = (SOCKET, "rfc2217://")
_SERIAL_PORT = re.compile(r"/\S+|COM[0-9]+")
BusName = Annotated[str, Field(pattern=r"^\w[\w .+-]*$", max_length=40)]
_URL_FORMS = "/dev/ttyUSB0, COM3, socket://host:port, rfc2217://host:port, or loopback://name for the twin"


def _right_way_out(range_mm: tuple[float, float]) -> tuple[float, float]:
    low_mm, high_mm = range_mm
    if not low_mm < high_mm:
        raise ValueError(f"[{low_mm:g}, {high_mm:g}] is inside out: the first must be below the second; exchange them")
    return range_mm


EndMm = Annotated[float, within(-200.0, 200.0)]
RangeMm = Annotated[tuple[EndMm, EndMm], Field(strict=False), AfterValidator(_right_way_out)]


class WireSection(Section):
    """One leg's drive, written out; it takes the place of what the bus's rule says about this leg.

    `leg` counts from 1; `address` and `axis` count as the protocol does; without `axis` it is the first.
    """

    facet: FacetId
    leg: Annotated[int, within(1, 12)]
    address: Annotated[int, within(1, 255)]
    axis: Annotated[int, within(0, 9)] | None = None
    sign: Literal[1, -1] | None = None


class BusSection(Section):
    """One line and the drives on it.

    The rule: the legs of `facet_ids`, facet by facet and leg by leg, fill the axes of one address after the other,
    from `first_address` on. `drive_map` names a register map or holds it.
    """

    name: BusName
    url: Annotated[str, Field(min_length=1, max_length=1000)]
    protocol: ProtocolName
    baud: Annotated[int, within(300, 4_000_000)] | None = None
    timeout_s: Annotated[float, within(0.005, 10.0)] = 0.1
    retries: Annotated[int, within(0, 20)] = 3
    has_echo: bool = False
    turnaround_s: Annotated[float, within(0.0, 1.0)] = 0.0
    max_moving: Annotated[int, within(1, 1000)]
    drive_map: FileName | dict[str, Any] | None = None
    facet_ids: Annotated[tuple[FacetId, ...], Field(strict=False)] = ()
    first_address: Annotated[int, within(1, 255)] = 1
    axes_per_address: Annotated[int, within(1, 9)] = 1
    wires: Annotated[tuple[WireSection, ...], Field(strict=False)] = ()

    @field_validator("url")
    @classmethod
    def _names_a_line(cls, url: str) -> str:
        if url.startswith(NETWORK):
            try:
                is_whole = bool(urlsplit(url).hostname) and urlsplit(url).port is not None
            except ValueError:  # a port that is no number or beyond 65535
                is_whole = False
        elif url.startswith(LOOPBACK):
            is_whole = len(url) > len(LOOPBACK)
        else:
            is_whole = _SERIAL_PORT.fullmatch(url) is not None
        if not is_whole:
            raise ValueError(f"{url!r} names no line; write one of {_URL_FORMS}")
        return url

    @model_validator(mode="after")
    def _is_whole(self) -> BusSection:
        if (self.protocol in MODBUS) != (self.drive_map is not None):
            has = "no" if self.drive_map is None else "a"
            raise ValueError(
                'drive_map goes with protocol = "modbus_rtu" or "modbus_tcp"; this bus has protocol = '
                f'"{self.protocol}" and {has} drive_map'
            )
        if self.protocol == "modbus_tcp" and not self.url.startswith((SOCKET, LOOPBACK)):
            raise ValueError(
                f'url = "{self.url}" is no TCP line, but protocol = "modbus_tcp"; write socket://host:port '
                '(Modbus TCP listens on port 502), or protocol = "modbus_rtu"'
            )
        if not self.facet_ids and not self.wires:
            raise ValueError("wires no leg: give facet_ids, or wires, or both")
        n_axes = AXES[self.protocol][1] - AXES[self.protocol][0] + 1
        if self.axes_per_address > n_axes:
            raise ValueError(
                f'axes_per_address = {self.axes_per_address}, must be at most {n_axes} for protocol = "{self.protocol}"'
            )
        return self


def _at_least_one(buses: tuple[BusSection, ...]) -> tuple[BusSection, ...]:
    # not by min_length, which also counts buses with a problem as missing
    if not buses:
        raise ValueError("there is no bus; add [[actuators.buses]] for each line")
    return buses


class MotionSection(Section):
    """How legs are moved; everything has a default.

    `max_travel_per_cycle_mm`: without it the mount's travel_limit_mm. `arrival_tolerance_um`: without it twice what a
    healthy drive may stand from its target, two steps for drives that count steps.
    """

    max_travel_per_cycle_mm: Annotated[float, within(0.001, 200.0)] | None = None
    approach_mm: Annotated[float, within(0.0, 5.0)] = 0.05
    arrival_tolerance_um: Annotated[float, within(0.01, 1000.0)] | None = None
    settle_s: Annotated[float, within(0.0, 60.0)] = 0.1
    poll_s: Annotated[float, within(0.005, 5.0)] = 0.05


class ActuatorsSection(Section):
    """The drives that move the legs.

    `step_um` is the leg's travel per count of drives that count steps; register maps in metres know their own.
    `sign` is 1 where counting up moves a leg along +z, to the sky, else -1. `range_mm` are the soft limits, from the
    drives' reference, already with the sign in them: positions of the leg.
    """

    step_um: Annotated[float, within(0.0001, 200.0)] | None = None
    sign: Literal[1, -1] = 1
    range_mm: RangeMm
    speed_mm_per_s: Annotated[float, within(0.001, 100.0)]
    acceleration_mm_per_s2: Annotated[float, within(0.01, 10_000.0)]
    motion: MotionSection = MotionSection()
    buses: Annotated[tuple[BusSection, ...], Field(strict=False), AfterValidator(_at_least_one)]
