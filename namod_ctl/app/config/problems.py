"""What is wrong with a config, told to the person who wrote it: key, value, rule and remedy."""

from __future__ import annotations

import difflib
import re
import types
import typing
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

# The units a key may end with, those of this program and those people write by mistake.
LENGTH_WORDS = {"m", "mm", "cm", "um", "km", "inch", "inches", "meter", "meters", "metre", "metres"}
ANGLE_WORDS = {"deg", "degs", "degree", "degrees", "mdeg", "rad", "mrad", "urad", "arcmin", "arcsec"}
OTHER_WORDS = {"px", "pixel", "pixels", "s", "s2", "sec", "ms", "us", "adu", "per", "turn", "rev", "revolution"}
UNIT_WORDS = LENGTH_WORDS | ANGLE_WORDS | OTHER_WORDS


def stem_and_unit(key: str) -> tuple[str, str]:
    """A key without its unit, and the unit: `plate_scale_mdeg_per_px` is `plate_scale` and `mdeg_per_px`."""
    words = key.split("_")
    n_stem = len(words)
    while n_stem > 1 and words[n_stem - 1] in UNIT_WORDS:
        n_stem -= 1
    return "_".join(words[:n_stem]), "_".join(words[n_stem:])


def describe_problems(error: ValidationError, root: type[BaseModel], source: str) -> list[str]:
    """One text per problem that pydantic found in a config of the sections `root`, in the order of the file's keys."""
    texts: list[str] = []
    explained: set[str] = set()  # missing keys whose misspelt form was found
    details = error.errors()
    inside_wrong = {detail["loc"][:n] for detail in details for n in range(len(detail["loc"]))}
    unknown_first = sorted(details, key=lambda detail: detail["type"] != "extra_forbidden")
    for detail in unknown_first:
        if detail["type"] == "too_short" and detail["loc"] in inside_wrong:
            continue  # its entries with a problem are not counted as entries
        path, model, value_type = _walk(root, detail["loc"])
        key_path = _key_path(path)
        if detail["type"] == "extra_forbidden":
            text, meant = _unknown_key(str(path[-1]), detail["input"], model)
            text = f": {text}"
            if meant is not None:
                explained.add(_key_path([*path[:-1], meant]))
        elif detail["type"] == "missing" and key_path in explained:
            continue
        else:
            text = _wrong_value(detail, key_path, value_type)
        texts.append(f"{source}: {key_path}{text}" if key_path else f"{source}{text}")
    return texts


def _key_path(path: list[str | int]) -> str:
    """`reflector.facets[2].width_m`; entries of lists count from 1, as a person would."""
    text = ""
    for step in path:
        text += f"[{step + 1}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def _members(annotation: Any) -> list[Any]:
    """The alternatives of a union, without None and annotations."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _members(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [m for part in typing.get_args(annotation) for m in _members(part) if m is not type(None)]
    return [annotation]


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _walk(root: type[BaseModel], loc: tuple[str | int, ...]) -> tuple[list[str | int], type[BaseModel], Any]:
    """The keys of a pydantic location without its union tags, the section of the last key, and that key's type."""
    path: list[str | int] = []
    section, current = root, [root]
    for step in loc:
        tagged = [m for m in current if _is_section(m) and _tag(m) == step]
        sections = [m for m in current if _is_section(m)]
        if isinstance(step, str) and tagged and len(sections) > 1:
            current = tagged  # the name of an alternative, which is no key of the file
            continue
        path.append(step)
        if isinstance(step, int):
            arguments = [a for m in current for a in typing.get_args(m) if a is not Ellipsis]
            current = _members(arguments[min(step, len(arguments) - 1)]) if arguments else []
        elif sections:
            section = sections[0]
            field = section.model_fields.get(step)
            current = _members(field.annotation) if field is not None else []
        else:
            current = []
    return path, section, current


def _tag(section: type[BaseModel]) -> str | None:
    field = section.model_fields.get("kind")
    return typing.get_args(field.annotation)[0] if field is not None else None


def _unknown_key(key: str, value: Any, section: type[BaseModel]) -> tuple[str, str | None]:
    """What to say about a key that does not exist, and the key that was meant, if that is clear."""
    known = list(section.model_fields)
    stem, unit = stem_and_unit(key)
    shown = "" if isinstance(value, dict | list) else f" (value {_shown(value)})"
    for candidate in known:
        candidate_stem, candidate_unit = stem_and_unit(candidate)
        if candidate_stem == stem and candidate_unit:
            given = f"is in {unit.replace('_', ' ')}" if unit else "says no unit"
            return (
                f"{given}{shown}, but this value is expected in {candidate_unit.replace('_', ' ')}: "
                f"convert it and write {candidate}"
            ), candidate
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.6) or difflib.get_close_matches(
        stem, known, n=1, cutoff=0.6
    )
    if close:
        return f"unknown key{shown}; did you mean {close[0]}?", close[0]
    return f"unknown key{shown}; known here are {', '.join(known)}", None


def _wrong_value(detail: ErrorDetails, key_path: str, value_type: list[Any]) -> str:
    """What to say about a value, or its absence, to follow its key: ` = 80.0 is ...`, `: this key is missing`."""
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    key = key_path.rsplit(".", 1)[-1].split("[")[0]
    unit = stem_and_unit(key)[1].replace("_", " ")
    in_unit = f" {unit}" if unit else ""
    if kind == "missing":
        what = "section" if any(_is_section(member) for member in value_type) else "key"
        return f": this {what} is missing{f'; add it, in {unit}' if unit else '; add it'}"
    if kind == "union_tag_not_found":
        return ": the key kind is missing; add kind = " + " or ".join(_kinds(value_type))
    if kind == "union_tag_invalid":
        return f".kind = {context.get('tag')!r} is unknown; known are {' and '.join(_kinds(value_type))}"
    if kind == "value_error":
        text = str(context["error"])
        return f"{_joint(text)}{text}"
    if kind in ("greater_than_equal", "less_than_equal"):
        side, limit = ("at least", context["ge"]) if kind == "greater_than_equal" else ("at most", context["le"])
        remedy = f"check sign and unit, {unit} is expected" if unit else "correct it"
        return f" = {_shown(value)} is not plausible, must be {side} {limit:g}{in_unit}; {remedy}"
    if kind == "finite_number":
        return f" = {_shown(value)} is no finite number; give one{f' in {unit}' if unit else ''}"
    return f" = {_shown(value)} does not fit; the {detail['msg'][0].lower()}{detail['msg'][1:]}"


def _joint(text: str) -> str:
    """Between a key and what a rule of its section says: which begins with a key of the section, or with the value."""
    if re.match(r"\w+ = ", text):
        return "."
    return " = " if text[:1] in "['" else ": "


def _shown(value: Any) -> str:
    """A value as the file has it, cut where it gets long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _kinds(value_type: list[Any]) -> list[str]:
    return [f'"{_tag(member)}"' for member in value_type if _is_section(member)]
