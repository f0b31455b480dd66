"""Register maps of Modbus drives from the contents of their files (`tomllib` dicts), all problems found together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from firmware_protocols.errors import LocalProtocolError
from firmware_protocols.modbus_drive import (
    READ_FUNCTIONS,
    TYPES,
    WORD_ORDERS,
    WRITE_FUNCTIONS,
    Condition,
    FaultCodes,
    Register,
    RegisterMap,
    RunUnless,
    Step,
    Term,
    WaitFor,
    WriteConstant,
    WritePosition,
    WriteTarget,
)
from firmware_protocols.modbus_map_values import Findings

SECTIONS = (
    "name",
    "source",
    "word_order",
    "reached_within",
    "registers",
    "roles",
    "status",
    "fault_codes",
    "sequences",
)
REGISTER_KEYS = ("address", "type", "read", "write", "word_order", "scale", "offset", "unit")
POSITION_UNITS = ("steps", "m")
UNITS = (*POSITION_UNITS, "steps/s", "m/s", "steps/s2", "m/s2", "K", "")
ROLES = ("target", "target_readback", "position", "speed", "accelerations", "temperature", "identity")
SEQUENCES = ("move", "stop", "home", "enable", "configure", "clear_faults")
STEP_SHAPES = ({"write", "value"}, {"wait", "is", "timeout_s"}, {"run", "unless"})
MAX_ADDRESS = 0xFFFF
MAX_TIMEOUT_S = 60.0


class RegisterMapError(LocalProtocolError):
    """A register map contradicts itself or Modbus; `problems` holds one text for each thing that is wrong."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


def read_register_map(raw: Mapping[str, Any]) -> RegisterMap:
    """The register map that a file describes.

    Raises
    ------
    RegisterMapError
        All problems together, each with key, value, rule and remedy.
    """
    return _Reader(raw).read()


class _Reader(Findings):
    def __init__(self, raw: Mapping[str, Any]) -> None:
        super().__init__()
        self.raw = raw

    def read(self) -> RegisterMap:
        self.unknown_keys("", self.raw, SECTIONS)
        registers = self._registers(self.table("registers", self.raw))
        _overlaps(registers.values(), self.problems)
        conditions = self._conditions(self.table("status", self.raw), registers)
        roles = self._roles(self.table("roles", self.raw), registers)
        sequences = self._sequences(self.table("sequences", self.raw), registers, conditions)
        fault_codes = self._fault_codes(registers)
        reached_within = self.number("", self.raw, "reached_within", None, low=0.0)
        name, source = self.text(self.raw, "name"), self.text(self.raw, "source")
        self._check_roles(roles, registers)
        self._check_sequences(sequences, conditions, roles.get("target"), reached_within)
        if self.problems:
            raise RegisterMapError(self.problems)
        return RegisterMap(
            name=name,
            source=source,
            registers=registers,
            target=roles["target"],
            target_readback=roles.get("target_readback", roles["target"]),
            position=roles["position"],
            conditions=conditions,
            sequences=sequences,
            speed=roles.get("speed"),
            accelerations=tuple(roles.get("accelerations", ())),
            temperature=roles.get("temperature"),
            identity=tuple(roles.get("identity", ())),
            fault_codes=fault_codes,
            reached_within=reached_within,
        )

    def _registers(self, table: Mapping[str, Any]) -> dict[str, Register]:
        registers = {}
        for name, raw in table.items():
            where = f"registers.{name}"
            if not isinstance(raw, dict):
                self.problems.append(f"{where}: must be a table of {', '.join(REGISTER_KEYS)}")
                continue
            n_before = len(self.problems)
            self.unknown_keys(where, raw, REGISTER_KEYS)
            type_ = self.choice(where, raw, "type", tuple(TYPES), None)
            address = self.whole(where, raw, "address", 0, MAX_ADDRESS)
            read = self.function(where, raw, "read", READ_FUNCTIONS)
            write = self.function(where, raw, "write", WRITE_FUNCTIONS)
            default_order = self.raw.get("word_order", "high_first")
            word_order = self.choice(where, {"word_order": default_order, **raw}, "word_order", WORD_ORDERS, None)
            scale = self.number(where, raw, "scale", 1.0)
            offset = self.number(where, raw, "offset", 0.0)
            unit = self.choice(where, raw, "unit", UNITS, "")
            if read is None and write is None and n_before == len(self.problems):
                self.problems.append(f"{where}: needs read = 3 or 4, or write = 6 or 16, else nobody can use it")
            if scale == 0.0:
                self.problems.append(f"{where}.scale: must not be 0: value = raw * scale + offset")
            if len(self.problems) > n_before:
                continue
            register = Register(
                name, address, type_, word_order, read, write, float(scale or 1.0), float(offset or 0.0), unit
            )
            if register.count > 1 and write == 6:
                self.problems.append(
                    f"{where}.write: function 6 writes 16 bits, and a half-written {type_} could start a move; give 16"
                )
            if address + register.count - 1 > MAX_ADDRESS:
                self.problems.append(
                    f"{where}.address: {address} leaves no room for {type_}, the last is {MAX_ADDRESS}"
                )
            registers[name] = register
        return registers

    def _conditions(self, table: Mapping[str, Any], registers: Mapping[str, Register]) -> dict[str, Condition]:
        conditions = {}
        for name, raw in table.items():
            where = f"status.{name}"
            if not isinstance(raw, dict) or not isinstance(raw.get("all"), list) or not raw["all"]:
                self.problems.append(f"{where}: needs all = [{{ register = ..., mask = ..., value = ... }}, ...]")
                continue
            self.unknown_keys(where, raw, ("all", "fault"))
            fault = raw.get("fault")
            if fault is not None and not isinstance(fault, str):
                self.problems.append(f"{where}.fault: {fault!r} must be a text for a person")
            terms = [self._term(f"{where}.all[{index}]", term, registers) for index, term in enumerate(raw["all"])]
            conditions[name] = Condition(name, tuple(term for term in terms if term is not None), fault)
        return conditions

    def _term(self, where: str, raw: Any, registers: Mapping[str, Register]) -> Term | None:
        if not isinstance(raw, dict):
            self.problems.append(f"{where}: must be a table of register, mask, value")
            return None
        n_before = len(self.problems)
        self.unknown_keys(where, raw, ("register", "mask", "value"))
        register = self._known(where, raw.get("register"), registers)
        all_bits = 0xFFFF if register is None else (1 << 16 * register.count) - 1
        mask = self.whole(where, raw, "mask", 1, all_bits)
        value = self.whole(where, {"value": mask, **raw}, "value", 0, all_bits)
        if register is not None and (register.read is None or not register.type.startswith("uint")):
            self.problems.append(f"{where}: register {register.name} must be a readable uint16 or uint32 to have bits")
        if n_before == len(self.problems) and value & ~mask:
            self.problems.append(f"{where}: value 0x{value:X} has bits outside of mask 0x{mask:X}: never true")
        return Term(register.name, mask, value) if register is not None and n_before == len(self.problems) else None

    def _roles(self, table: Mapping[str, Any], registers: Mapping[str, Register]) -> dict[str, Any]:
        self.unknown_keys("roles", table, ROLES)
        roles: dict[str, Any] = {}
        for role in ROLES:
            if role in ("accelerations", "identity"):
                names = table.get(role, [])
                if not isinstance(names, list):
                    self.problems.append(f"roles.{role}: must be a list of registers")
                    continue
                found = [self._known(f"roles.{role}", name, registers) for name in names]
                roles[role] = [register.name for register in found if register is not None]
            elif role in table:
                register = self._known(f"roles.{role}", table[role], registers)
                if register is not None:
                    roles[role] = register.name
            elif role in ("target", "position"):
                self.problems.append(f"roles.{role}: missing; name the register of the drive's {role}")
        return roles

    def _check_roles(self, roles: Mapping[str, Any], registers: Mapping[str, Register]) -> None:
        def check(role: str, name: str | None, units: tuple[str, ...] | None, *, read: bool, write: bool) -> None:
            if name is None:
                return
            register = registers[name]
            if units is not None and register.unit not in units:
                self.problems.append(f"roles.{role}: register {name} has unit {register.unit!r}, needs {units[0]}")
            if read and register.read is None:
                self.problems.append(f"roles.{role}: register {name} must be readable: give read = 3 or 4")
            if write and register.write is None:
                self.problems.append(f"roles.{role}: register {name} must be writable: give write = 6 or 16")

        position = roles.get("position")
        length = registers[position].unit if position is not None else "steps"
        if length not in POSITION_UNITS:
            self.problems.append(f"roles.position: register {position} has unit {length!r}, needs steps or m")
            length = "steps"
        check("position", position, None, read=True, write=False)
        check("target", roles.get("target"), (length,), read=False, write=True)
        check("target_readback", roles.get("target_readback", roles.get("target")), (length,), read=True, write=False)
        check("speed", roles.get("speed"), (f"{length}/s",), read=False, write=True)
        check("temperature", roles.get("temperature"), ("K",), read=True, write=False)
        for name in roles.get("accelerations", ()):
            check("accelerations", name, (f"{length}/s2",), read=False, write=True)
        for name in roles.get("identity", ()):
            check("identity", name, None, read=True, write=False)

    def _sequences(
        self,
        table: Mapping[str, Any],
        registers: Mapping[str, Register],
        conditions: Mapping[str, Condition],
    ) -> dict[str, tuple[Step, ...]]:
        self.unknown_keys("sequences", table, SEQUENCES)
        sequences = {}
        for name, raw in table.items():
            if not isinstance(raw, list) or not raw:
                self.problems.append(f"sequences.{name}: must be a list of steps")
                continue
            steps = [
                self._step(f"sequences.{name}[{index}]", step, registers, conditions, table)
                for index, step in enumerate(raw)
            ]
            sequences[name] = tuple(step for step in steps if step is not None)
        return sequences

    def _step(
        self,
        where: str,
        raw: Any,
        registers: Mapping[str, Register],
        conditions: Mapping[str, Condition],
        sequences: Mapping[str, Any],
    ) -> Step | None:
        if not isinstance(raw, dict) or set(raw) not in STEP_SHAPES:
            self.problems.append(
                f"{where}: must be {{ write, value }}, {{ wait, is, timeout_s }} or {{ run, unless }}, not {raw!r}"
            )
            return None
        if "write" in raw:
            return self._write(where, raw, registers)
        condition = raw["wait"] if "wait" in raw else raw["unless"]
        if not isinstance(condition, str) or condition not in conditions:
            self.problems.append(f"{where}: there is no status.{condition}")
            return None
        if "wait" in raw:
            if not isinstance(raw["is"], bool):
                self.problems.append(f"{where}.is: {raw['is']!r} must be true or false")
            timeout_s = self.number(where, raw, "timeout_s", None, low=0.0, high=MAX_TIMEOUT_S)
            return WaitFor(condition, raw["is"], timeout_s or 0.0)
        inner = sequences.get(raw["run"]) if isinstance(raw["run"], str) else None
        if not isinstance(inner, list):
            self.problems.append(f"{where}: there is no sequences.{raw['run']}")
        elif any(isinstance(step, dict) and "run" in step for step in inner):
            self.problems.append(f"{where}: sequences.{raw['run']} runs another one itself; write its steps out")
        return RunUnless(raw["run"], condition)

    def _write(self, where: str, raw: Mapping[str, Any], registers: Mapping[str, Register]) -> Step | None:
        register = self._known(f"{where}.write", raw["write"], registers)
        if register is None:
            return None
        if register.write is None:
            self.problems.append(f"{where}: register {register.name} must be writable: give write = 6 or 16")
        value = raw["value"]
        if value == "target":
            return WriteTarget(register.name)
        if value == "position":
            return WritePosition(register.name)
        try:
            if isinstance(value, (bool, str)):
                raise LocalProtocolError('a raw number, "target" or "position"')
            register.encode_raw(value)
        except (LocalProtocolError, TypeError) as problem:
            self.problems.append(f"{where}.value: {value!r} cannot be written: {problem}")
            return None
        return WriteConstant(register.name, value)

    def _check_sequences(
        self,
        sequences: Mapping[str, tuple[Step, ...]],
        conditions: Mapping[str, Condition],
        target: str | None,
        reached_within: float | None,
    ) -> None:
        self.problems += [
            f"sequences.{name}: missing; no drive goes without" for name in ("move", "stop") if name not in sequences
        ]
        for name, steps in sequences.items():
            targets = [step.register for step in steps if isinstance(step, WriteTarget)]
            if name == "move" and targets != [target] and target is not None:
                self.problems.append(f'sequences.move: must write value = "target" once, to roles.target ({target})')
            if name != "move" and targets:
                self.problems.append(f"sequences.{name}: only sequences.move has a target")
            if any(isinstance(step, WritePosition) and step.register != target for step in steps):
                self.problems.append(f'sequences.{name}: value = "position" can only be written to roles.target')
        if "home" in sequences and "homed" not in conditions:
            self.problems.append("status.homed: missing; a drive that must be homed has to say when it is")
        if "moving" not in conditions and reached_within is None:
            self.problems.append(
                "status.moving: missing; without it, reached_within must say how close to the target the drive stands"
            )

    def _fault_codes(self, registers: Mapping[str, Register]) -> FaultCodes | None:
        if "fault_codes" not in self.raw:
            return None
        table = self.table("fault_codes", self.raw)
        self.unknown_keys("fault_codes", table, ("register", "texts"))
        register = self._known("fault_codes.register", table.get("register"), registers)
        texts = {}
        for key, text in self.table("texts", table, "fault_codes.").items():
            try:
                texts[int(key, 0)] = str(text)
            except ValueError:
                self.problems.append(f"fault_codes.texts.{key}: the key must be a number such as 0x2310")
        if register is not None and (register.read is None or not register.type.startswith("uint")):
            self.problems.append(f"fault_codes.register: {register.name} must be a readable uint16 or uint32")
        return FaultCodes(register.name, texts) if register is not None else None

    def _known(self, where: str, name: Any, registers: Mapping[str, Register]) -> Register | None:
        if isinstance(name, str) and name in registers:
            return registers[name]
        wrong_itself = isinstance(name, str) and name in self.table("registers", self.raw)
        if not wrong_itself:  # else the register's own problem is in the list
            self.problems.append(f"{where}: there is no register {name!r}; known: {', '.join(registers)}")
        return None


def _overlaps(registers: Iterable[Register], problems: list[str]) -> None:
    """Two names for one register, unless one can only be read and the other only be written."""
    known = list(registers)
    for index, first in enumerate(known):
        for second in known[index + 1 :]:
            shared = sorted(set(first.addresses) & set(second.addresses))
            same_read = first.read is not None and first.read == second.read
            same_write = first.write is not None and second.write is not None
            read_while_written = (first.read == 3 and second.write is not None) or (
                second.read == 3 and first.write is not None
            )
            only = (first.read is None and second.write is None) or (second.read is None and first.write is None)
            if shared and (same_read or same_write or (read_while_written and not only)):
                problems.append(
                    f"registers.{first.name} and registers.{second.name} overlap at address {shared[0]}; "
                    "check addresses and types"
                )
