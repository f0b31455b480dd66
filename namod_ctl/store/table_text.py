"""Reading tables of numbers from text files, with errors that name file, line, column and value."""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from namod_ctl.core.errors import ConfigError

# What the simulations and people write, `.1098400` and `1e3` too, but not `nan`, `inf`, `0x10` or `1_000`.
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
MAX_REPORTED_PROBLEMS = 20


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table that is not a comment: its number in the file, its fields, and the file's name."""

    source: str
    line: int
    fields: tuple[str, ...]

    def problem(self, text: str) -> ConfigError:
        """An error that names file and line."""
        return ConfigError(f"{self.source}, line {self.line}: {text}")

    def number(self, column: int, name: str, low: float, high: float, unit: str) -> float:
        """The number in a column (counted from 0), refused if it is none or outside `low` to `high`."""
        text = self.fields[column]
        where = f"column {column + 1} ({name})"
        value = float(text) if NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise self.problem(f"{where} holds {text!r}, which is not a finite number")
        if not low <= value <= high:
            raise self.problem(f"{where} holds {text}, allowed is {low:g} to {high:g} {unit}: check the unit")
        return value

    def whole_number(self, column: int, name: str) -> int:
        """The number in a column (counted from 0), refused if it is not a whole number from 0 to 999999."""
        text = self.fields[column]
        if not re.fullmatch(r"[0-9]{1,6}", text):
            raise self.problem(f"column {column + 1} ({name}) holds {text!r}, which is not a whole number 0 to 999999")
        return int(text)


def read_text(path: Path) -> str:
    """The text of a file; ConfigError if it is missing, cannot be opened or is no UTF-8 text."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file (byte {error.start} is no UTF-8): give the right file") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole or not at all."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def lines(text: str) -> Iterator[tuple[int, str]]:
    """Numbered lines as an editor counts them."""
    yield from enumerate(text.replace("\r\n", "\n").split("\n"), start=1)


def raise_together(problems: list[ConfigError]) -> None:
    """Raise all problems of a file as one error; nothing happens if there is none."""
    if not problems:
        return
    texts = [str(problem) for problem in problems[:MAX_REPORTED_PROBLEMS]]
    if len(problems) > MAX_REPORTED_PROBLEMS:
        texts.append(f"... and {len(problems) - MAX_REPORTED_PROBLEMS} more")
    raise ConfigError("\n".join(texts))


def refuse_repeated_ids(source: str, ids: list[int]) -> None:
    """Raise ConfigError if an id occurs twice."""
    repeated = sorted({facet_id for facet_id in ids if ids.count(facet_id) > 1})
    if repeated:
        raise ConfigError(f"{source}: facet ids occur more than once: {', '.join(map(str, repeated))}")
