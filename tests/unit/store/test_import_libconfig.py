"""Files in libconfig's format: examples of its manual, and any text whatever."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from namod_files import reflector_cfg

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.libconfig import parse_libconfig


def test_settings_in_all_their_spellings() -> None:
    # comments, both separators, optional terminators, number formats, adjacent strings: libconfig's manual, section 3
    group = parse_libconfig(
        """
        # a comment   /* another */  // a third
        a : { x = 0x10; y : -1.5e1, z = 3L; name = "two " "words";
              list = ( { id = 1; }, { id : 2 } ); on = TRUE; }
        """,
        "file",
    ).group("a")
    assert group.integer("x") == 16
    assert group.number("y") == -15.0
    assert group.integer("z") == 3
    assert group.text("name") == "two words"
    assert [item.integer("id") for item in group.groups("list")] == [1, 2]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = 1;\nb = ;\n", "file, line 2"),
        ("a = {\n b = 1;\n", "file, line 3.*end of the file"),
        ('a = 1;\n\nb = "not closed;\n', "file, line 3"),
        ("a = 1;\nb = . ;\n", "file, line 2"),
        ('a = "\\xzz";', "file, line 1"),
        ("a = 09;", "file, line 1"),
        ('a = 1;\n@include "/etc/passwd"\n', "file, line 2"),
        ("a = " + "(" * 100_000, "too deeply"),
    ],
)
def test_syntax_errors_name_the_line(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parse_libconfig(text, "file")


def test_values_of_another_kind_name_the_key() -> None:
    group = parse_libconfig(
        'g = { t = "x"; b = true; big = 1e999; huge = 1' + "0" * 400 + "; n = -2; l = (1); };", "f"
    ).group("g")
    for read, words in (
        (lambda: group.number("t"), "f: g: t = 'x' is not a number"),
        (lambda: group.number("b"), "b = True is not a number"),
        (lambda: group.number("big"), "big is not a finite number"),
        (lambda: group.number("huge"), "huge is not a finite number"),
        (lambda: group.positive_number("n"), "n = -2 must be above 0"),
        (lambda: group.text("n"), "n = -2 is not a string"),
        (lambda: group.group("n"), "n is not a group"),
        (lambda: group.groups("n"), "n is not a list"),
        (lambda: group.groups("l"), r"l\[0\] is not a group"),
        (lambda: group.number("gone"), "gone is missing"),
    ):
        with pytest.raises(ConfigError, match=words):
            read()


@given(st.text(max_size=100) | st.text(alphabet='ab=:;{}()[],."\\x1eL@#/* \n-', max_size=60))
@example("a = 1" + "0" * 5000 + ";")
def test_any_text_parses_or_is_refused(text: str) -> None:
    message = "file"
    try:
        parse_libconfig(text, "file")
    except ConfigError as error:
        message = str(error)
    assert message.startswith("file")


@given(st.integers(0, len(reflector_cfg().rstrip()) - 5))
def test_a_cut_file_never_passes(length: int) -> None:
    text = reflector_cfg().rstrip()[:length]
    try:
        settings = parse_libconfig(text, "file")
    except ConfigError:
        return
    with pytest.raises(ConfigError, match="reflector is missing"):
        settings.group("reflector")
