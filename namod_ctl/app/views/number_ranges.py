"""Many numbers in few words: facet ids with runs drawn together, legs by what they have in common."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError

_RUN = re.compile(r"([0-9]{1,9})(?:\s*(?:-|to)\s*([0-9]{1,9}))?")
_MOST_NUMBERS = 10_000
"""More than any telescope has facets: a slip of the finger in a run must not fill the memory."""


def runs_in_words(numbers: Iterable[int]) -> str:
    """Numbers in ascending order, each once, with runs of three and more drawn together: `0, 2 to 7, 10`."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)


def numbers_of_words(text: str) -> tuple[int, ...]:
    """What `runs_in_words` wrote, or a person in a hurry: `0, 2 to 7, 10` or `0,2-7,10`; each once, as they come.

    Raises
    ------
    ConfigError
        Some part is no number and no run of ascending numbers, or there are too many; says which part.
    """
    numbers: dict[int, None] = {}
    for word in (part.strip() for part in text.split(",")):
        match = _RUN.fullmatch(word)
        if match is None:
            raise ConfigError(f"{word!r} is no number; give numbers with commas between, such as 13,31 or 2-7")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"{word!r} goes downwards; write {last}-{first}")
        if last - first >= _MOST_NUMBERS:
            raise ConfigError(f"{word!r} are {last - first + 1} numbers; at most {_MOST_NUMBERS} in one run are taken")
        numbers.update(dict.fromkeys(range(first, last + 1)))
    return tuple(numbers)


def legs_in_words(legs: Iterable[Leg]) -> str:
    """Legs by facets of which the same ones are meant: `facets 0, 2 to 7 legs 1 to 3; facet 13 leg 2`."""
    numbers_of: dict[int, set[int]] = defaultdict(set)
    for leg in legs:
        numbers_of[leg.facet_id].add(leg.index + 1)
    facets_with: dict[frozenset[int], list[int]] = defaultdict(list)
    for facet_id in sorted(numbers_of):
        facets_with[frozenset(numbers_of[facet_id])].append(facet_id)
    return "; ".join(
        f"{_plural('facet', facet_ids)} {runs_in_words(facet_ids)} {_plural('leg', numbers)} {runs_in_words(numbers)}"
        for numbers, facet_ids in facets_with.items()
    )


def counted(number: int, noun: str) -> str:
    """`1 leg`, `2 legs`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}es" if noun.endswith("s") else f"{number} {noun}s"


def _plural(noun: str, what: Iterable[int]) -> str:
    return noun if len(list(what)) == 1 else f"{noun}s"
