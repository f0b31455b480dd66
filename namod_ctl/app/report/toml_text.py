"""Plain values as TOML: the config and the twin's settings as they were used, as files that the program reads again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any


def to_toml(sections: Mapping[str, Any]) -> str:
    """TOML of nested mappings, sequences, texts, numbers and booleans; what is None is left out.

    The first level becomes tables, all below inline, one line per element of a list of mappings.
    """
    plain = [f"{_key(key)} = {_value(value)}" for key, value in sections.items() if _is_plain(value)]
    tables = []
    for name, section in sections.items():
        if isinstance(section, Mapping):
            lines = [f"{_key(key)} = {_value(value)}" for key, value in section.items() if value is not None]
            tables.append("\n".join([f"[{_key(name)}]", *lines]))
    return "\n\n".join((["\n".join(plain)] if plain else []) + tables) + "\n"


def _is_plain(value: object) -> bool:
    return value is not None and not isinstance(value, Mapping)


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else _text(key)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(str(key))} = {_value(each)}" for key, each in value.items() if each is not None)
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, Sequence):
        if any(isinstance(each, Mapping) for each in value):
            return "[\n" + "".join(f"  {_value(each)},\n" for each in value) + "]"
        return f"[{', '.join(map(_value, value))}]"
    raise TypeError(f"{type(value)} has no place in TOML")
