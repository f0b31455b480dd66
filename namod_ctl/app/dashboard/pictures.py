"""Frames as pictures that a phone can load: those kept with the records, else the newest that the recorder shows."""

from __future__ import annotations

import json
from collections import OrderedDict
from pathlib import Path
from typing import Final

from namod_ctl.core.errors import StoreError
from namod_ctl.store.live_pictures import live_picture, picture_of
from namod_ctl.store.run import RunStore

_MAX_KEPT: Final = 8


class Pictures:
    """Makes pictures, and remembers the last ones: many pages ask for the same. For one thread."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[Path, str, int], bytes] = OrderedDict()

    def picture(self, run: Path, camera: str, index: int) -> bytes | None:
        """The frame of a record as JPEG, brightened; None when it is not there, not any more, or unreadable."""
        key = (run, camera, index)
        if key not in self._kept:
            data = live_picture(run, index, camera) or _of_kept_frame(run, camera, index)
            if data is None:
                return None
            self._kept[key] = data
            while len(self._kept) > _MAX_KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]


def _of_kept_frame(run: Path, camera: str, index: int) -> bytes | None:
    try:
        with RunStore.open(run) as store:
            full_scale_adu = float(json.loads(store.config_json)[camera]["full_scale_adu"])
            return picture_of(store.frame(index, camera), full_scale_adu)
    except StoreError:
        return None
