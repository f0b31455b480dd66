"""Kept frames as pictures that a phone can load: smaller, as JPEG, and brightened, as nearly all of them is night."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from namod_ctl.core.errors import StoreError
from namod_ctl.store.run import RunStore

MAX_COLUMNS: Final = 960
_QUALITY: Final = 75
_MAX_KEPT: Final = 8
_BRIGHTENED: Final = np.rint(255.0 * (np.arange(256) / 255.0) ** 0.5).astype(np.uint8)


class Pictures:
    """Makes pictures, and remembers the last ones: many pages ask for the same. For one thread."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[Path, str, int], bytes] = OrderedDict()

    def picture(self, run: Path, camera: str, index: int) -> bytes | None:
        """The square root of the frame as JPEG, at most `MAX_COLUMNS` wide; None when it is not there or unreadable."""
        key = (run, camera, index)
        if key not in self._kept:
            try:
                with RunStore.open(run) as store:
                    frame = store.frame(index, camera)
            except StoreError:
                return None
            shrink = min(1.0, MAX_COLUMNS / frame.shape[1])
            if shrink < 1.0:
                size = (round(frame.shape[1] * shrink), round(frame.shape[0] * shrink))
                frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
            is_encoded, data = cv2.imencode(".jpg", _BRIGHTENED[frame], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            if not is_encoded:
                return None
            self._kept[key] = data.tobytes()
            while len(self._kept) > _MAX_KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]
