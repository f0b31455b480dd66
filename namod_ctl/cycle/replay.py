"""Stored frames behind the cameras' interface: a run is recorded again, on the same path as from the sky."""

from __future__ import annotations

import math
from collections.abc import Sequence

from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.records import Record
from namod_ctl.cycle.pairs import SourceExhaustedError
from namod_ctl.store.frames import decode_png, read_verified
from namod_ctl.store.run import RunStore

CAMERAS = ("star_camera", "reflector_camera")


class ReplayCamera:
    """A camera that shows the frames of a run's records one after the other, whatever exposure it is asked for.

    Parameters
    ----------
    camera
        One of `CAMERAS`.
    """

    def __init__(self, run: RunStore, records: Sequence[Record], camera: str) -> None:
        self._run_name, self._camera = run.path.name, camera
        self._files = run.frame_files(camera)
        self._records = iter(records)

    @property
    def name(self) -> str:
        """The camera and where its frames come from."""
        return f"{self._camera} of {self._run_name}"

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Any exposure: it is not used."""
        return 0.0, math.inf

    def start(self, exposure_s: float) -> None:
        """Nothing to do."""

    def fetch(self, timeout_s: float) -> Exposure:
        """The frame of the next record.

        Raises
        ------
        SourceExhaustedError
            There are no more.
        StoreError
            The frame is missing or has changed.
        """
        record = next(self._records, None)
        if record is None:
            raise SourceExhaustedError
        file, sha256 = self._files[record.index]
        try:
            image = decode_png(read_verified(file, sha256))
        except ValueError as error:
            raise StoreError(f"{file}: {error}") from error
        is_star = self._camera == CAMERAS[0]
        return Exposure(
            image=image,
            exposure_s=record.star_exposure_s if is_star else record.reflector_exposure_s,
            mid_exposure_s=record.star_mid_exposure_s if is_star else record.reflector_mid_exposure_s,
            frame_id=record.index,
        )

    def close(self) -> None:
        """Nothing to do: the run belongs to whoever opened it."""


class ReplayClock:
    """Time in a replay does not pass."""

    def monotonic_s(self) -> float:
        """Always 0."""
        return 0.0

    def wait_s(self, duration_s: float) -> None:
        """Nothing to wait for."""


def replayable_records(run: RunStore) -> list[Record]:
    """Records of the run whose frames were kept.

    Raises
    ------
    ConfigError
        There are none.
    """
    kept = set.intersection(*(set(run.frame_files(camera)) for camera in CAMERAS))
    records = [record for record in run.records() if record.index in kept]
    if not records:
        raise ConfigError(
            f"{run.path}: no frames were kept, so it cannot be replayed; record (or import) with --keep-frames all"
        )
    return records
