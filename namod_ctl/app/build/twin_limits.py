"""A twin's settings as a person wrote them: angles in the units they were given in, and limits told in those."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from namod_ctl.core.units import arcmin_to_rad, arcsec_to_rad, deg_to_rad
from namod_ctl.twin.faults import CATALOGUE
from namod_ctl.twin.settings import FaultSpec, Limits, TwinSettings

ANGLES: Mapping[str, Callable[[float], float]] = {
    "deg": deg_to_rad,
    "arcmin": arcmin_to_rad,
    "arcsec": arcsec_to_rad,
}


@dataclass(frozen=True, slots=True)
class Written:
    """What stands in the file for a setting: its key and value there, and what 1 of its unit is in ours."""

    key: str
    value: Any
    unit: float


Origins = dict[tuple[str | int, ...], Written]


def in_radians(
    section: Mapping[str, Any], origins: Origins, problems: list[str], path: tuple[str | int, ...] = ()
) -> dict[str, Any]:
    """The section with its angles in rad; what stands where in the file goes into `origins`, by our keys.

    A setting that is given twice, in two units, is one of the `problems`.
    """
    converted: dict[str, Any] = {}
    for key, value in section.items():
        words = key.split("_")
        units = [unit for unit in ANGLES if unit in words[1:]]
        name = "_".join("rad" if word in units else word for word in words)
        convert = ANGLES[units[0]] if units else _as_it_is
        here = (*path, name)
        if name in converted:
            problems.append(f"{dotted((*path, key))} = {value!r}: is given a second time, as {origins[here].key}")
            continue
        origins[here] = Written(key, value, convert(1.0))
        if isinstance(value, dict):
            converted[name] = in_radians(value, origins, problems, here)
        elif isinstance(value, list):
            converted[name] = [
                in_radians(v, origins, problems, (*here, i)) if isinstance(v, dict) else _converted(v, convert)
                for i, v in enumerate(value)
            ]
        else:
            converted[name] = _converted(value, convert)
    return converted


def dotted(path: tuple[str | int, ...]) -> str:
    """A place in the file as people write it."""
    return ".".join(map(str, path))


def as_written(path: tuple[str | int, ...], origins: Origins) -> str:
    """A place among our settings as it is called in the file."""
    return dotted(tuple(origins[path[: i + 1]].key if path[: i + 1] in origins else p for i, p in enumerate(path)))


def beyond_limits(raw: Mapping[str, Any], origins: Origins) -> Iterator[str]:
    """Settings outside of their limits, with those in the unit of the file. What is no number is not looked at."""
    for path, limits in _limits(raw):
        written = origins.get(path)
        value: Any = raw
        for step in path:
            value = value[step]
        numbers = value if isinstance(value, list) else [value]
        if written is None or not all(_is_number(number) for number in numbers):
            continue
        if not all(limits.least <= number <= limits.most for number in numbers):
            least, most = limits.least / written.unit, limits.most / written.unit
            yield f"{as_written(path, origins)} = {written.value!r}: must be from {least:.4g} to {most:.4g}"


def _limits(raw: Mapping[str, Any]) -> Iterator[tuple[tuple[str | int, ...], Limits]]:
    """The limits of all settings that are given in `raw`."""
    yield from _limits_in(TwinSettings, raw, ())
    faults = raw.get("faults")
    for i, fault in enumerate(faults if isinstance(faults, list) else []):
        if not isinstance(fault, dict):
            continue
        yield from _limits_in(FaultSpec, fault, ("faults", i))
        kind, params = CATALOGUE.get(str(fault.get("name"))), fault.get("params")
        if kind is None or not isinstance(params, dict):
            continue
        for key in params:
            if key in kind.defaults and (limits := kind.limits_of(key)) is not None:
                yield ("faults", i, "params", key), limits


def _limits_in(
    kind: type, raw: Mapping[str, Any], path: tuple[str | int, ...]
) -> Iterator[tuple[tuple[str | int, ...], Limits]]:
    for key, hint in get_type_hints(kind, include_extras=True).items():
        if key not in raw:
            continue
        if is_dataclass(hint) and isinstance(hint, type) and isinstance(raw[key], dict):
            yield from _limits_in(hint, raw[key], (*path, key))
        elif get_origin(hint) is Annotated:
            yield from (((*path, key), extra) for extra in get_args(hint)[1:] if isinstance(extra, Limits))


def _as_it_is(value: float) -> float:
    return value


def _converted(value: Any, convert: Callable[[float], float]) -> Any:
    return convert(value) if _is_number(value) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
