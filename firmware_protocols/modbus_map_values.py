"""Values of a register map's file, checked one by one; what is wrong is noted, and the reading goes on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_protocols.modbus_drive import INFINITY


class Findings:
    """Reads values by key; `problems` collects one text for each that is wrong, and something harmless stands in."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def table(self, key: str, raw: Mapping[str, Any], prefix: str = "") -> Mapping[str, Any]:
        """A table of the file; an empty one if it is absent or none."""
        table = raw.get(key, {})
        if isinstance(table, dict):
            return table
        self.problems.append(f"{prefix}{key}: must be a table, not {table!r}")
        return {}

    def unknown_keys(self, where: str, raw: Mapping[str, Any], known: tuple[str, ...]) -> None:
        """Note keys that mean nothing: a misspelt one must not be overlooked."""
        prefix = f"{where}." if where else ""
        self.problems += [f"{prefix}{key}: unknown; known here: {', '.join(known)}" for key in raw if key not in known]

    def text(self, raw: Mapping[str, Any], key: str) -> str:
        """A text that must be there."""
        text = raw.get(key)
        if not isinstance(text, str) or not text.strip():
            self.problems.append(f"{key}: missing; say in words what drive this is and where the map is from")
            return ""
        return text

    def choice(
        self, where: str, raw: Mapping[str, Any], key: str, choices: tuple[str, ...], default: str | None
    ) -> str:
        """One of several texts."""
        value = raw.get(key, default)
        if value in choices:
            return str(value)
        self.problems.append(f"{where}.{key}: {value!r} is none of {', '.join(map(repr, choices))}")
        return choices[0]

    def function(self, where: str, raw: Mapping[str, Any], key: str, codes: tuple[int, ...]) -> int | None:
        """A Modbus function code, None if absent."""
        value = raw.get(key)
        if value is None or (type(value) is int and value in codes):
            return value
        self.problems.append(f"{where}.{key}: {value!r} is none of the function codes {' and '.join(map(str, codes))}")
        return None

    def whole(self, where: str, raw: Mapping[str, Any], key: str, low: int, high: int) -> int:
        """A whole number that must be there."""
        value = raw.get(key)
        if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
            return value
        self.problems.append(f"{where}.{key}: {value!r} must be a whole number from {low} to {high}")
        return low

    def number(
        self,
        where: str,
        raw: Mapping[str, Any],
        key: str,
        default: float | None,
        low: float = -INFINITY,
        high: float = INFINITY,
    ) -> float | None:
        """A finite number, `default` if absent."""
        value = raw.get(key, default)
        if value is None and key not in raw:
            return None
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if is_number and low <= value <= high and -INFINITY < value < INFINITY:
            return float(value)
        prefix = f"{where}." if where else ""
        self.problems.append(f"{prefix}{key}: {value!r} must be a number from {low:g} to {high:g}")
        return None
