"""Buses of drives as the config describes them: a line, the link of its protocol, and a drive for every leg."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Literal, Protocol, TypedDict

from namod_ctl.core.drives import ByteTransport, Drive, Leg
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.drive_maps import RegisterMap
from namod_ctl.devices.links import LineSettings, LinkStatistics, TmclLink, ZaberLink
from namod_ctl.devices.modbus_drive import ModbusDrive
from namod_ctl.devices.modbus_link import Framing, ModbusLink
from namod_ctl.devices.tmcl_drive import TmclDrive
from namod_ctl.devices.transports import NO_LOOPBACKS, LoopbackTransport, open_transport
from namod_ctl.devices.zaber_drive import ZaberDrive

_HURRIED_BYTES, _HURRIED_REACTION_S, _HURRIED_MOST_S = 64, 0.01, 0.03
"""So many bytes on the line, so long for the drive, and so long in all at most: what an order to stop is waited for."""
_BITS_PER_BYTE = 11

ProtocolName = Literal["tmcl", "zaber", "modbus_rtu", "modbus_tcp"]


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """One leg's drive.

    Attributes
    ----------
    address, axis
        Module and motor (from 0) in TMCL, device and axis (from 1) in Zaber, unit in Modbus, where the axis is idle.
    steps_per_m
        Counts per travel of the leg along +z, with sign.
    """

    leg: Leg
    address: int
    axis: int
    steps_per_m: float


@dataclass(frozen=True, slots=True)
class BusSettings:
    """One line and what is on it.

    Attributes
    ----------
    url, baud
        See `open_transport`.
    range_m, speed_m_per_s, acceleration_m_per_s2
        Of all its legs.
    register_map
        Of Modbus drives, else None.
    """

    name: str
    url: str
    protocol: ProtocolName
    baud: int
    line: LineSettings
    max_moving: int
    drives: tuple[DriveSettings, ...]
    range_m: tuple[float, float]
    speed_m_per_s: float
    acceleration_m_per_s2: float
    register_map: RegisterMap | None = None


class _Link(Protocol):
    statistics: LinkStatistics

    def hurry(self, timeout_s: float | None) -> None: ...
    def close(self) -> None: ...


class _ConfigurableDrive(Drive, Protocol):
    def configure(self) -> None: ...


class _LegSettings(TypedDict):
    steps_per_m: float
    range_m: tuple[float, float]
    speed_m_per_s: float
    acceleration_m_per_s2: float


class DriveBus:
    """Drives on an open line; satisfies `core.drives.Bus`. Nothing is said on the line before `connect`."""

    def __init__(self, settings: BusSettings, transport: ByteTransport) -> None:
        self._settings = settings
        self._link, self._drives = _drives_on(transport, settings)
        self._line_name = transport.name
        self.unreachable: dict[Leg, str] = {}

    @property
    def name(self) -> str:
        """Name from the config and its line."""
        return f"{self._settings.name} ({self._line_name})"

    @property
    def drives(self) -> dict[Leg, Drive]:
        """All drives that the config names, by their legs: those that do not answer, too."""
        return dict(self._drives)

    @property
    def max_moving(self) -> int:
        """So many drives may move at once."""
        return self._settings.max_moving

    @property
    def statistics(self) -> LinkStatistics:
        """What its line went through."""
        return self._link.statistics

    def hurry(self, is_hurried: bool) -> None:
        """Give every question one short attempt, or as many as usual again. Safe from any thread.

        Questions follow each other before late answers are through; an answer's own time on the line is waited for,
        so that none is talked into.
        """
        timeout_s = _HURRIED_REACTION_S + _HURRIED_BYTES * _BITS_PER_BYTE / self._settings.baud
        self._link.hurry(min(timeout_s, _HURRIED_MOST_S) if is_hurried else None)

    def connect(self) -> dict[Leg, str]:
        """Tell every drive its speed and acceleration; the legs whose drives do not answer or refuse, and why.

        Call it again when a line or a drive has come back. The drives that answer are not held up by those that do
        not; the result is kept as `unreachable`.
        """
        self.unreachable = {}
        for leg, drive in self._drives.items():
            try:
                drive.configure()
            except (CommunicationError, DeviceFaultError) as problem:
                self.unreachable[leg] = str(problem)
        return self.unreachable

    def scan(self) -> list[str]:
        """One line per address that the config names: its legs, and what answers there or what is wrong."""
        legs_at: dict[int, list[Leg]] = defaultdict(list)
        for settings in self._settings.drives:
            legs_at[settings.address].append(settings.leg)
        lines = []
        for address, legs in legs_at.items():
            try:
                found = self._drives[legs[0]].identity()
            except (CommunicationError, DeviceFaultError) as problem:
                found = f"does not answer properly: {problem}"
            lines.append(f"address {address} ({', '.join(map(str, legs))}): {found}")
        return lines

    def close(self) -> None:
        """Let go of the line."""
        self._link.close()


def open_bus(settings: BusSettings, loopbacks: Mapping[str, Callable[[bytes], bytes]] = NO_LOOPBACKS) -> DriveBus:
    """The bus on its open line; nothing has been said to the drives yet.

    Raises
    ------
    ConfigError
        The port does not exist, is in use or not permitted, or the settings do not fit the kind of drive.
    CommunicationError
        The host of a TCP line does not answer.
    """
    check_drives(settings)
    return DriveBus(settings, open_transport(settings.url, settings.baud, loopbacks))


def open_buses(
    settings: Sequence[BusSettings], loopbacks: Mapping[str, Callable[[bytes], bytes]] = NO_LOOPBACKS
) -> list[DriveBus]:
    """All buses, open and connected, in their order; drives that do not answer are in each bus's `unreachable`.

    Raises
    ------
    ConfigError, CommunicationError
        What is wrong with all lines that cannot be opened, together; none is left open. A `ConfigError` when the
        config or a local port is to blame for any.
    """
    buses: list[DriveBus] = []
    problems: list[ConfigError | CommunicationError] = []
    for wanted in settings:
        try:
            buses.append(open_bus(wanted, loopbacks))
        except (ConfigError, CommunicationError) as problem:
            problems.append(type(problem)(f"bus {wanted.name!r}: {problem}"))
    if problems:
        for good in buses:
            good.close()
        kind = ConfigError if any(isinstance(problem, ConfigError) for problem in problems) else CommunicationError
        raise kind("\n".join(map(str, problems)))
    with ExitStack() as opened, ThreadPoolExecutor(max_workers=max(len(buses), 1)) as workers:
        for bus in buses:
            opened.callback(bus.close)
        list(workers.map(DriveBus.connect, buses))  # in threads: a dead line must not hold up the others
        opened.pop_all()
    return buses


def check_drives(settings: BusSettings) -> None:
    """Refuse settings that the kind of drive cannot take, without opening anything. Raises ConfigError."""
    _drives_on(LoopbackTransport(f"bus {settings.name!r}", lambda data: b""), settings)


def _drives_on(transport: ByteTransport, settings: BusSettings) -> tuple[_Link, dict[Leg, _ConfigurableDrive]]:
    wired = [(drive, _leg_settings(settings, drive)) for drive in settings.drives]
    if settings.protocol == "tmcl":
        tmcl = TmclLink(transport, settings.line)
        return tmcl, {drive.leg: TmclDrive(tmcl, drive.address, drive.axis, **leg) for drive, leg in wired}
    if settings.protocol == "zaber":
        zaber = ZaberLink(transport, settings.line)
        return zaber, {drive.leg: ZaberDrive(zaber, drive.address, drive.axis, **leg) for drive, leg in wired}
    register_map = settings.register_map
    if register_map is None:
        raise ConfigError(f"bus {settings.name!r}: drives on Modbus need a register map")
    modbus = ModbusLink(transport, settings.line, Framing.TCP if settings.protocol == "modbus_tcp" else Framing.RTU)
    return modbus, {drive.leg: ModbusDrive(modbus, drive.address, register_map, **leg) for drive, leg in wired}


def _leg_settings(settings: BusSettings, drive: DriveSettings) -> _LegSettings:
    return {
        "steps_per_m": drive.steps_per_m,
        "range_m": settings.range_m,
        "speed_m_per_s": settings.speed_m_per_s,
        "acceleration_m_per_s2": settings.acceleration_m_per_s2,
    }
