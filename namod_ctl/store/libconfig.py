"""Files in libconfig's format, the original program's, and their values with checks that name file and key."""

from __future__ import annotations

import math
from pathlib import Path

import libconf

from namod_ctl.core.errors import ConfigError


class Group:
    """A group of settings that knows where it stands, so that every complaint can say it."""

    def __init__(self, settings: dict[str, object], where: str) -> None:
        self._settings = settings
        self.where = where

    def number(self, key: str) -> float:
        """A finite number. Raises ConfigError."""
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{self.where}: {key} = {value!r} is not a number")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise ConfigError(f"{self.where}: {key} is not a finite number")
        return number

    def positive_number(self, key: str) -> float:
        """A finite number above 0. Raises ConfigError."""
        number = self.number(key)
        if number <= 0.0:
            raise ConfigError(f"{self.where}: {key} = {number:g} must be above 0")
        return number

    def integer(self, key: str) -> int:
        """A whole number. Raises ConfigError."""
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, int):
            raise ConfigError(f"{self.where}: {key} = {value!r} is not a whole number")
        return int(value)

    def text(self, key: str) -> str:
        """A string. Raises ConfigError."""
        value = self._value(key)
        if not isinstance(value, str):
            raise ConfigError(f"{self.where}: {key} = {value!r} is not a string")
        return value

    def group(self, key: str) -> Group:
        """A group `{ ... }`. Raises ConfigError."""
        return _as_group(self._value(key), f"{self.where}: {key}")

    def groups(self, key: str) -> list[Group]:
        """A list `( ... )` of groups. Raises ConfigError."""
        value = self._value(key)
        if not isinstance(value, tuple):
            raise ConfigError(f"{self.where}: {key} is not a list ( ... )")
        return [_as_group(item, f"{self.where}: {key}[{number}]") for number, item in enumerate(value)]

    def _value(self, key: str) -> object:
        if key not in self._settings:
            raise ConfigError(f"{self.where}: {key} is missing")
        return self._settings[key]


def parse_libconfig(text: str, source: str) -> Group:
    """The settings in `text`. Raises ConfigError, naming `source` and line, for anything that is not libconfig.

    `@include` is refused: the original program does not write it, and it would read files nobody named.
    """
    tokenizer = libconf.Tokenizer(source)
    try:
        stream = libconf.TokenStream(tokenizer.tokenize(text))
    except (libconf.ConfigParseError, ValueError) as error:  # ValueError: a number or an escape that is none
        raise ConfigError(f"{source}, line {tokenizer.row}: this is not libconfig; correct the line") from error
    try:
        return Group(libconf.Parser(stream).parse(), source)
    except libconf.ConfigParseError as error:
        token = stream.peek()
        row = tokenizer.row if token is None else token.row
        found = "the end of the file" if token is None else repr(token.text[:40])
        raise ConfigError(
            f"{source}, line {row}: libconfig syntax error at {found}; is the file cut off or a bracket missing?"
        ) from error
    except RecursionError as error:
        raise ConfigError(f"{source}: the groups are nested too deeply") from error


def read_libconfig(path: Path) -> Group:
    """The settings in a file. Raises ConfigError, naming file and line; FileNotFoundError when there is none."""
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not a text file ({error.reason} at byte {error.start})") from error
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    return parse_libconfig(text, str(path))


def _as_group(value: object, where: str) -> Group:
    if not isinstance(value, dict):
        raise ConfigError(f"{where} is not a group {{ ... }}")
    return Group(value, where)
