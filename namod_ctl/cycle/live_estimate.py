"""The live estimate: what a run would reconstruct to at this moment, worked out beside the recording.

In a process of its own at low priority, so that neither the cameras nor the reduction wait for it. It reads the
run from the disk; it is asked again when the run has grown by a fifth, so all estimates of a run together cost a few
times the last one.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from namod_ctl.core.errors import NamodError
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.run import RunStore

FIRST_AT_RECORDS = 50
GROWTH = 1.2
_NICENESS = 10


@dataclass(frozen=True, slots=True)
class LiveEstimate:
    """What the robust estimator makes of the run so far.

    Attributes
    ----------
    n_records
        Accepted records it rests on.
    worst_uncertainty_rad
        Larger half axis of the error ellipse (one standard deviation) of the facet that is known worst.
    worst_facet_id
        That facet.
    n_without
        Facets without any estimate yet.
    """

    n_records: int
    worst_uncertainty_rad: float
    worst_facet_id: int
    n_without: int


class LiveEstimator:
    """Estimates the run at `path` now and then; a context manager that ends its process."""

    def __init__(self, path: Path, instrument: Instrument) -> None:
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, path, instrument), daemon=True)
        # Ctrl-C reaches all processes of a terminal; the new one inherits that it is ignored, only we are interrupted
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._process.start()
        finally:
            signal.signal(signal.SIGINT, before)
        theirs.close()
        self._is_busy = False
        self._asked_at = 0
        self.latest: LiveEstimate | None = None

    def update(self, n_accepted: int) -> LiveEstimate | None:
        """The latest estimate; asks for a new one when the run has grown enough. Returns at once."""
        try:
            if self._is_busy and self._connection.poll():
                self.latest = self._connection.recv() or self.latest
                self._is_busy = False
            if not self._is_busy and n_accepted >= max(FIRST_AT_RECORDS, GROWTH * self._asked_at):
                self._connection.send(None)
                self._is_busy, self._asked_at = True, n_accepted
        except (EOFError, OSError):  # its process is gone, perhaps for lack of memory: recording matters more
            self._is_busy = True
        return self.latest

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self._connection.close()


def estimate_run(path: Path, instrument: Instrument) -> LiveEstimate | None:
    """What the run at `path` reconstructs to; None while its records are too few or too bad."""
    try:
        with RunStore.open(path) as run:
            table = tabulate_responses(run.records(), run.facet_ids)
        facets = reconstruct(table, instrument).alignment.facets
    except NamodError:
        return None
    variances = np.array([np.linalg.eigvalsh(np.nan_to_num(facet.theta_cov_rad2))[-1] for facet in facets])
    worst = int(variances.argmax())
    return LiveEstimate(
        n_records=table.n_records,
        worst_uncertainty_rad=float(np.sqrt(variances[worst])),
        worst_facet_id=facets[worst].facet_id,
        n_without=int(sum(not np.isfinite(facet.theta_rad).all() for facet in facets)),
    )


def _serve(connection: Connection, path: Path, instrument: Instrument) -> None:
    os.nice(_NICENESS)
    try:
        while True:
            connection.recv()
            connection.send(estimate_run(path, instrument))
    except (EOFError, OSError):  # the recorder is gone
        return
