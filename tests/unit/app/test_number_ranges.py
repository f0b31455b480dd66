"""Many numbers in few words: nothing is lost, nothing is made up."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.app.views.number_ranges import counted, legs_in_words, numbers_of_words, runs_in_words
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError


def read_runs(text: str) -> list[int]:
    """What a person would understand."""
    numbers: list[int] = []
    for part in filter(None, text.split(", ")):
        first, _, last = part.partition(" to ")
        numbers += range(int(first), int(last or first) + 1)
    return numbers


@given(st.lists(st.integers(0, 60)))
def test_a_person_reads_the_same_numbers_each_once_in_order(numbers: list[int]) -> None:
    assert read_runs(runs_in_words(numbers)) == sorted(set(numbers))


@given(st.sets(st.builds(Leg, st.integers(0, 12), st.integers(0, 5))))
def test_a_person_reads_the_same_legs(legs: set[Leg]) -> None:
    read = set()
    for part in filter(None, legs_in_words(legs).split("; ")):
        match = re.fullmatch(r"facets? (.+?) legs? (.+)", part)
        assert match is not None, part
        read |= {Leg(facet_id, n - 1) for facet_id in read_runs(match[1]) for n in read_runs(match[2])}
    assert read == legs


def test_it_reads_well() -> None:
    assert legs_in_words([Leg(f, k) for f in (2, 3, 4, 9) for k in range(3)] + [Leg(13, 1)]) == (
        "facets 2 to 4, 9 legs 1 to 3; facet 13 leg 2"
    )


@pytest.mark.parametrize(("n", "noun", "text"), [(1, "leg", "1 leg"), (0, "leg", "0 legs"), (2, "bus", "2 buses")])
def test_counted(n: int, noun: str, text: str) -> None:
    assert counted(n, noun) == text


@given(st.lists(st.integers(0, 60), min_size=1))
def test_what_was_written_can_be_typed_again(numbers: list[int]) -> None:
    assert numbers_of_words(runs_in_words(numbers)) == tuple(sorted(set(numbers)))
    assert numbers_of_words(runs_in_words(numbers).replace(" to ", "-")) == tuple(sorted(set(numbers)))


def test_numbers_are_kept_as_they_come_each_once() -> None:
    assert numbers_of_words("31, 13,2-4,3 to 5,31") == (31, 13, 2, 3, 4, 5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "'' is no number"),
        ("13;31", "such as 13,31"),
        ("-3", "'-3' is no number"),
        ("2-", "'2-' is no number"),
        ("\u0663", "is no number"),
        ("1e3", "is no number"),
        ("7-2", "write 2-7"),
        ("1-999999999", "at most 10000"),
        ("9" * 30, "is no number"),
    ],
)
def test_what_is_no_number_is_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        numbers_of_words(text)


@given(st.text(max_size=20))
def test_any_text_is_numbers_or_refused(text: str) -> None:
    try:
        numbers = numbers_of_words(text)
    except ConfigError:
        return
    assert numbers
    assert all(0 <= number < 2**31 for number in numbers)
