"""What drives that share a line have in common: who listens to an address, and what two answers at once become."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Unit = TypeVar("Unit")

Heard = Callable[[bytes], None]
"""Told every sound telegram that may change a drive, alone and whole, before the drives act on it."""

Listeners = Callable[[int], Sequence[Unit]]
"""From an address to the drives that listen to it: one, none, or more when somebody set a switch wrongly."""


def hear_nothing(telegram: bytes) -> None:
    """Nobody keeps a record of what the drives are told."""


def collide(answers: Sequence[bytes]) -> bytes:
    """What arrives when several drives answer at once: their bits meet on the wire, and a 0 wins over a 1.

    Answers that are equal arrive as one: nobody can tell that there were two.
    """
    if not answers:
        return b""
    length = max(len(answer) for answer in answers)
    mixed = bytearray(b"\xff" * length)
    for answer in answers:
        for i, byte in enumerate(answer):
            mixed[i] &= byte
    return bytes(mixed)
