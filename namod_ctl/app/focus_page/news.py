"""What the page is told of each frame, and how it gets there."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True, slots=True)
class FocusNews:
    """One frame; None is what is not known.

    Attributes
    ----------
    at_s
        When it came, on a clock that never goes back.
    size_px, best_px
        Full width of the star at half maximum, and the least so far.
    arcmin_per_px
        None when the camera's plate scale is not known.
    peak_share
        Height of the star, of full scale.
    exposure_s
        None when no frame came.
    warning
        What keeps the star from being measured, and what to do; "" for nothing.
    picture_px
        Width of the cut-out of the frame that comes with the news.
    """

    at_s: float
    size_px: float | None
    best_px: float | None
    arcmin_per_px: float | None
    peak_share: float | None
    exposure_s: float | None
    warning: str
    picture_px: int | None = None


def packed(news: FocusNews, picture: bytes) -> bytes:
    """News and picture as one message to the page's process."""
    return json.dumps(asdict(news)).encode() + b"\n" + picture


def unpacked(message: bytes) -> tuple[FocusNews, bytes]:
    """News and picture of such a message."""
    text, _, picture = message.partition(b"\n")
    return FocusNews(**json.loads(text)), picture
