"""Position drives on Modbus, described by data: values <-> registers, status bits, sequences; for client and server.

What the registers of a drive mean is a `RegisterMap`; `modbus_map.read_register_map` makes one from a file's contents.
Framing and transport are not done here. Two kinds of numbers occur: a *raw* value is the number the registers hold
(int16 ... float32), a *value* is raw * scale + offset in the register's unit.

Source: MODBUS Application Protocol V1.1b3, sections 4.3 (big-endian registers of 16 bits) and 6 (functions).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError

READ_FUNCTIONS = (3, 4)  # read holding registers, read input registers
WRITE_FUNCTIONS = (6, 16)  # write single register, write multiple registers
MAX_READ_COUNT = 125  # registers per request: section 6.3
INFINITY = float("inf")
TYPES = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}  # struct formats
WORD_ORDERS = ("high_first", "low_first")


@dataclass(frozen=True, slots=True)
class Register:
    """One quantity in one or two 16-bit registers.

    Attributes
    ----------
    address
        Of its first register, counted from 0 as on the wire (a manual's 40001 is 0).
    type
        One of `TYPES`.
    word_order
        Which half of a 32-bit quantity stands at the lower address.
    read, write
        Function code by which it is read (3, 4) and written (6, 16); None when it cannot be.
    scale, offset
        value = raw * scale + offset, in `unit`.
    unit
        "steps", "m", "steps/s", "m/s", "steps/s2", "m/s2", "K", or "" for codes and bits.
    """

    name: str
    address: int
    type: str
    word_order: str = "high_first"
    read: int | None = None
    write: int | None = None
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""

    @property
    def count(self) -> int:
        """Number of 16-bit registers it takes."""
        return struct.calcsize(TYPES[self.type]) // 2

    @property
    def addresses(self) -> range:
        """The addresses it takes."""
        return range(self.address, self.address + self.count)

    def encode_raw(self, raw: float) -> tuple[int, ...]:
        """The 16-bit words of a raw value, in the order of their addresses.

        Raises
        ------
        LocalProtocolError
            The value does not fit the type.
        """
        try:
            data = struct.pack(TYPES[self.type], float(raw) if self.type == "float32" else _whole(raw))
        except (struct.error, OverflowError, ValueError):
            raise LocalProtocolError(f"register {self.name}: {raw!r} does not fit its type {self.type}") from None
        words = struct.unpack(f">{self.count}H", data)
        return words if self.word_order == "high_first" else words[::-1]

    def decode_raw(self, words: Sequence[int]) -> float:
        """The raw value of 16-bit words; whole except for float32.

        Raises
        ------
        RemoteProtocolError
            The number of words is wrong, one is no 16-bit number, or a float32 is infinite or no number.
        """
        if len(words) != self.count or not all(0 <= word <= 0xFFFF for word in words):
            raise RemoteProtocolError(f"register {self.name}: {list(words)} are not {self.count} words of 16 bits")
        ordered = words if self.word_order == "high_first" else words[::-1]
        raw = struct.unpack(TYPES[self.type], struct.pack(f">{self.count}H", *ordered))[0]
        if not -INFINITY < raw < INFINITY:
            raise RemoteProtocolError(f"register {self.name}: the peer sent {raw}, which is no value")
        return float(raw) if self.type == "float32" else int(raw)

    def raw_of(self, value: float) -> float:
        """The raw value nearest to a value in the register's unit; whole except for float32.

        Raises
        ------
        LocalProtocolError
            The value is infinite or no number.
        """
        if not -INFINITY < value < INFINITY:
            raise LocalProtocolError(f"register {self.name}: {value} cannot be written")
        raw = (value - self.offset) / self.scale
        return raw if self.type == "float32" else round(raw)

    def value_of(self, raw: float) -> float:
        """The value in the register's unit."""
        return raw * self.scale + self.offset

    def encode(self, value: float) -> tuple[int, ...]:
        """The words nearest to a value in the register's unit; raises as `raw_of` and `encode_raw`."""
        return self.encode_raw(self.raw_of(value))

    def decode(self, words: Sequence[int]) -> float:
        """The value in the register's unit of the words; raises as `decode_raw`."""
        return self.value_of(self.decode_raw(words))


def _whole(raw: float) -> int:
    if raw != int(raw):
        raise ValueError
    return int(raw)


@dataclass(frozen=True, slots=True)
class Term:
    """True when the bits `mask` of a register's raw value are `value`."""

    register: str
    mask: int
    value: int


@dataclass(frozen=True, slots=True)
class Condition:
    """A named statement on registers, true when all its terms are; `fault` puts it in words when it is a fault."""

    name: str
    terms: tuple[Term, ...]
    fault: str | None = None

    def holds(self, raws: Mapping[str, float]) -> bool:
        """Whether it is true of raw values by register name."""
        return all(int(raws[term.register]) & term.mask == term.value for term in self.terms)


@dataclass(frozen=True, slots=True)
class WriteConstant:
    """Write a raw value."""

    register: str
    raw: float


@dataclass(frozen=True, slots=True)
class WriteTarget:
    """Write the position that is asked for."""

    register: str


@dataclass(frozen=True, slots=True)
class WritePosition:
    """Write the position read back just before."""

    register: str


@dataclass(frozen=True, slots=True)
class WaitFor:
    """Go on when a condition is `holds`; `timeout_s` of wall time later the drive has failed."""

    condition: str
    holds: bool
    timeout_s: float


@dataclass(frozen=True, slots=True)
class RunUnless:
    """Run another sequence unless a condition holds already."""

    sequence: str
    unless: str


Step = WriteConstant | WriteTarget | WritePosition | WaitFor | RunUnless


@dataclass(frozen=True, slots=True)
class FaultCodes:
    """A register that says which fault it is (0: none), and its codes in words."""

    register: str
    texts: Mapping[int, str]

    def describe(self, raw: float) -> str:
        """A code for a person."""
        code = int(raw)
        return f"error 0x{code:04X}: {self.texts.get(code, 'see the manual of the drive')}"


@dataclass(frozen=True, slots=True)
class ReadBlock:
    """What one request reads."""

    function: int
    address: int
    count: int
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """What the registers of a kind of drive mean and how it is moved.

    Attributes
    ----------
    name, source
        What kind of drive, and where the map was taken from.
    registers
        By name.
    target, target_readback, position
        Names of the registers of the position asked for, of the same as the drive understood it, and of the position
        now; all in steps or all in metres.
    speed, accelerations, temperature, identity
        Names of registers that not every drive has.
    conditions
        By name. "moving", "homed" and "fault" (it will not move until that is cleared) have a fixed meaning; the others
        serve sequences and, if they have words, are faults, too.
    sequences
        By name: "move" and "stop", and where the drive has them "home", "enable", "configure", "clear_faults".
    reached_within
        In drives without a condition "moving": the drive stands when target and position differ by no more than this,
        in their unit.
    """

    name: str
    source: str
    registers: Mapping[str, Register]
    target: str
    target_readback: str
    position: str
    conditions: Mapping[str, Condition]
    sequences: Mapping[str, tuple[Step, ...]]
    speed: str | None = None
    accelerations: tuple[str, ...] = ()
    temperature: str | None = None
    identity: tuple[str, ...] = ()
    fault_codes: FaultCodes | None = None
    reached_within: float | None = None

    @property
    def position_unit(self) -> str:
        """ "steps" or "m"."""
        return self.registers[self.position].unit

    @property
    def has_homing(self) -> bool:
        """Whether the drive must seek a reference; one that need not always knows where it is."""
        return "home" in self.sequences

    def reads(self, names: Iterable[str]) -> tuple[ReadBlock, ...]:
        """The fewest requests that read these registers, each quantity whole in one of them.

        Requests are joined where nothing but registers of the map lies in between: drives refuse to read others.

        Raises
        ------
        LocalProtocolError
            One of them cannot be read.
        """
        blocks: list[ReadBlock] = []
        wanted = {self.registers[name] for name in names}
        known = {(register.read, address) for register in self.registers.values() for address in register.addresses}
        for register in sorted(wanted, key=lambda register: (register.read or 0, register.address)):
            if register.read is None:
                raise LocalProtocolError(f"register {register.name} cannot be read")
            last = blocks[-1] if blocks else None
            if (
                last is not None
                and last.function == register.read
                and register.addresses.stop - last.address <= MAX_READ_COUNT
                and all((last.function, gap) in known for gap in range(last.address + last.count, register.address))
            ):
                count = register.addresses.stop - last.address
                blocks[-1] = ReadBlock(last.function, last.address, count, (*last.names, register.name))
            else:
                blocks.append(ReadBlock(register.read, register.address, register.count, (register.name,)))
        return tuple(blocks)

    def decode_block(self, block: ReadBlock, words: Sequence[int]) -> dict[str, float]:
        """Raw values by name of the words that answer a request of `reads`. Raises RemoteProtocolError."""
        if len(words) != block.count:
            raise RemoteProtocolError(
                f"asked for {block.count} registers from {block.address} on, the peer sent {len(words)}"
            )
        raws = {}
        for name in block.names:
            register = self.registers[name]
            first = register.address - block.address
            raws[name] = register.decode_raw(words[first : first + register.count])
        return raws


class RegisterImage:
    """The raw values of a drive's registers, as its server holds them; no others exist than the map names."""

    def __init__(self, register_map: RegisterMap) -> None:
        self._map = register_map
        self._raws: dict[str, float] = dict.fromkeys(register_map.registers, 0)

    def __getitem__(self, name: str) -> float:
        return self._raws[name]

    def __setitem__(self, name: str, raw: float) -> None:
        self._map.registers[name].encode_raw(raw)
        self._raws[name] = raw

    def holds(self, name: str) -> bool:
        """Whether a condition is true now."""
        return self._map.conditions[name].holds(self._raws)

    def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
        """Words that answer a read request.

        Raises
        ------
        RemoteProtocolError
            Some of the addresses do not exist for this function (Modbus exception 2).
        """
        words = {
            word_address: word
            for register in self._map.registers.values()
            if register.read == function
            for word_address, word in zip(
                register.addresses, register.encode_raw(self._raws[register.name]), strict=True
            )
        }
        try:
            return tuple(words[wanted] for wanted in range(address, address + count))
        except KeyError as missing:
            raise RemoteProtocolError(f"function {function}: there is no register {missing}") from None

    def write(self, function: int, address: int, words: Sequence[int]) -> tuple[str, ...]:
        """Take a write request; the names of the registers that were written, in the order of their addresses.

        Single registers may be written by function 6 and 16, whichever the map names; nothing is written on an error.

        Raises
        ------
        RemoteProtocolError
            Some of the addresses cannot be written, or one half of a 32-bit quantity is missing (Modbus exception 2).
        """
        by_address = {register.address: register for register in self._map.registers.values() if register.write}
        written: dict[str, float] = {}
        at = address
        while at < address + len(words):
            register = by_address.get(at)
            end = at + register.count if register is not None else at
            if register is None or end > address + len(words) or function not in WRITE_FUNCTIONS:
                raise RemoteProtocolError(f"function {function}: register {at} cannot be written so")
            written[register.name] = register.decode_raw(words[at - address : end - address])
            at = end
        self._raws.update(written)
        return tuple(written)
