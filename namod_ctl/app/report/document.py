"""What a report is made of, whatever it is written as: sections of texts, tables, pictures and commands."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph; one that warns stands out."""

    text: str
    is_warning: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells under a head; without a head the first column names what the others say.

    Attributes
    ----------
    words
        Columns of words, which may break into lines; all others hold numbers and never break.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG; `words` say what it shows to those who cannot see it, and stand below it for all."""

    png: bytes
    words: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Lines to be typed or kept exactly as they are."""

    lines: tuple[str, ...]


Block = Text | Table | Picture | Listing


@dataclass(frozen=True, slots=True)
class Chapter:
    """A heading and what stands below it."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    chapters: tuple[Chapter, ...]
