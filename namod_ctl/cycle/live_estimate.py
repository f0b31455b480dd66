"""The live estimate: how well a run knows its facets at this moment, worked out beside the recording.

In a process of its own at low priority, so that neither the cameras nor the reduction wait for it. It reads the
run from the disk; it is asked again when the run has grown by a fifth.

It is what `reconstruct` would say, without what the crew does not look at meanwhile (corrections, histograms, ray
tracing). And it remembers what changes slowly from one estimate to the next: which records are bad, and how much worse
random halves of the run agree than they should (`uncertainty.repetition_factor`). That needs the fits of several pairs
of halves; here every estimate makes one pair, of half of the facets, and pools it with those of the estimates before.
"""

from __future__ import annotations

import math
import os
import signal
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError, NamodError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.reconstruction.bad_records import find_bad_records
from namod_ctl.reconstruction.facet_fit import FacetFit, centre_covariance
from namod_ctl.reconstruction.psf import area_now
from namod_ctl.reconstruction.quality import ScanRegion, judge_fit
from namod_ctl.reconstruction.reconstruct import MIN_RECORDS, expected_size_rad
from namod_ctl.reconstruction.responses import ResponseTable, tabulate_responses
from namod_ctl.reconstruction.robust import Family, fit_facets, fit_reflector
from namod_ctl.reconstruction.scene import without_scene
from namod_ctl.reconstruction.uncertainty import misfit_factors, pulls, repetition_factor, width_of_pulls
from namod_ctl.store.run import RunStore

FIRST_AT_RECORDS = 50
GROWTH = 1.2
_NICENESS = 10
_N_SPLITS_KEPT = 4  # with FACT's 30 facets 120 pulls: the factor on the uncertainty is good to 6 %
_LEAST_FACETS_PER_SPLIT, _MAX_FACETS_PER_SPLIT = 15, 50
_FEWEST_FOR_SPLITS = 300  # records; below, the factor depends on how the halves happen to fall, and all are made
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class LiveEstimate:
    """What the robust estimator makes of the run so far.

    Attributes
    ----------
    n_records
        Accepted records it rests on.
    worst_uncertainty_rad
        Larger half axis of the error ellipse (one standard deviation) of the facet that is known worst among those
        that shine; infinite when none does.
    worst_facet_id
        That facet.
    unseen_facet_ids
        Facets that showed no light in any record (NO_SIGNAL): nothing is known about them.
    a_sigma_rad2, a_sigma_uncertainty_rad2
        Area of the light of all facets that shine, see `reconstruction.psf.area_now`; NaN when none does.
    """

    n_records: int
    worst_uncertainty_rad: float
    worst_facet_id: int
    unseen_facet_ids: tuple[int, ...]
    a_sigma_rad2: float = math.nan
    a_sigma_uncertainty_rad2: float = math.nan


class LiveEstimator:
    """Estimates the run at `path` now and then, in a process of its own until `close`.

    Parameters
    ----------
    is_waited_for
        The recording can wait for every estimate that is due, as the twin can, whose time does not pass meanwhile.
    """

    def __init__(self, path: Path, instrument: Instrument, *, is_waited_for: bool = False) -> None:
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, path, instrument), daemon=True)
        # Ctrl-C reaches all processes of a terminal; the new one inherits that it is ignored, only we are interrupted
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            with _one_thread():
                self._process.start()
        finally:
            signal.signal(signal.SIGINT, before)
        theirs.close()
        self._is_busy = self._is_lost = False
        self._is_waited_for = is_waited_for
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
            self._is_busy = self._is_lost = True
        return self.latest

    def is_ready(self, timeout_s: float) -> bool:
        """Can the recording go on? Waits for an estimate under way, if it is to be waited for, so long at most."""
        if not self._is_waited_for or not self._is_busy or self._is_lost:
            return True
        try:
            return self._connection.poll(timeout_s)
        except (EOFError, OSError):
            return True

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self._connection.close()


class RunningEstimate:
    """Estimates of one run as it grows; what it remembers from one to the next makes them cheap."""

    def __init__(self, instrument: Instrument) -> None:
        self._expected_rad = expected_size_rad(instrument)
        self._bad_records: set[int] = set()
        self._pulls: deque[NDArray[np.float64]] = deque(maxlen=_N_SPLITS_KEPT)
        self._rng = np.random.default_rng(0)

    def of(self, table: ResponseTable) -> LiveEstimate:
        """The estimate of all records so far.

        Raises
        ------
        DataQualityError
            They are too few or too bad.
        """
        if table.n_records < MIN_RECORDS:
            raise DataQualityError(f"{table.n_records} records count, at least {MIN_RECORDS} are needed: record longer")
        family, fits = fit_reflector(self._without_bad(table), self._expected_rad)
        steady = without_scene(table, fits)
        if steady is not table:
            table = steady
            family, fits = fit_reflector(self._without_bad(table), self._expected_rad)
        used = self._without_bad(table)
        found = find_bad_records(table, fits, family.noise, float(np.exp(family.log_size)))
        self._bad_records = {record.index for record in found}  # left out the next time
        factors = self._repetition(used, family) * misfit_factors(fits)
        region = ScanRegion(used.theta_rad)
        size_rad = min(float(np.exp(family.log_size)), self._expected_rad)
        worst_rad2, worst_id, unseen = -np.inf, table.facet_ids[0], []
        seen: list[tuple[FacetFit, float]] = []
        for j, (facet_id, fit) in enumerate(zip(table.facet_ids, fits, strict=True)):
            verdict = None
            if fit is not None:
                verdict = judge_fit(fit, used, j, factors[j] * centre_covariance(fit), region, size_rad)
            if fit is None or verdict is None or verdict.flags & FacetFlag.NO_SIGNAL:
                unseen.append(facet_id)
                continue
            seen.append((fit, factors[j]))
            variance_rad2 = _larger_variance(verdict.centre_cov_rad2)
            if variance_rad2 > worst_rad2:
                worst_rad2, worst_id = variance_rad2, facet_id
        worst_rad = float(np.sqrt(worst_rad2)) if worst_rad2 >= 0.0 else np.inf
        area = AreaOfPsf(math.nan, math.nan)
        if seen:
            area = area_now([fit for fit, _ in seen], np.array([factor for _, factor in seen]))
        return LiveEstimate(
            table.n_records, worst_rad, worst_id, tuple(unseen), area.a_sigma_rad2, area.uncertainty_rad2
        )

    def _without_bad(self, table: ResponseTable) -> ResponseTable:
        used = table.select(~np.isin(table.record_index, list(self._bad_records)))
        if used.n_records < MIN_RECORDS:
            raise DataQualityError(f"{len(self._bad_records)} of {table.n_records} records disagree with the others")
        return used

    def _repetition(self, used: ResponseTable, family: Family) -> float:
        if used.n_records < _FEWEST_FOR_SPLITS:
            return repetition_factor(used, family)
        while True:  # the first time until enough are there
            self._pulls.append(self._pulls_of_a_split(used, family))
            if len(self._pulls) == _N_SPLITS_KEPT:
                break
        values = np.concatenate(self._pulls)
        return max(1.0, width_of_pulls(values) ** 2) if len(values) else 1.0

    def _pulls_of_a_split(self, used: ResponseTable, family: Family) -> NDArray[np.float64]:
        n_facets = len(used.facet_ids)
        n_fitted = min(max((n_facets + 1) // 2, _LEAST_FACETS_PER_SPLIT), n_facets, _MAX_FACETS_PER_SPLIT)
        facets = np.sort(self._rng.choice(n_facets, n_fitted, replace=False))
        order = self._rng.permutation(used.n_records)
        halves = (np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :]))
        first, second = (fit_facets(used.select(half), family, facets) for half in halves)
        return pulls(first, second)


def _larger_variance(cov_rad2: NDArray[np.float64]) -> float:
    """Variance along the larger half axis of an error ellipse; infinite for one that is not known."""
    return float(np.linalg.eigvalsh(cov_rad2)[-1]) if np.isfinite(cov_rad2).all() else np.inf


def _estimate(path: Path, running: RunningEstimate) -> LiveEstimate | None:
    try:
        with RunStore.open(path) as run:
            table = tabulate_responses(run.records(), run.facet_ids)
        return running.of(table)
    except NamodError:  # of a run that is young or bad: there is nothing to say yet
        return None


def _serve(connection: Connection, path: Path, instrument: Instrument) -> None:
    os.nice(_NICENESS)
    running = RunningEstimate(instrument)
    try:
        while True:
            connection.recv()
            connection.send(_estimate(path, running))
    except (EOFError, OSError):  # the recorder is gone
        return


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started meanwhile do their linear algebra in one thread: more of them only take the cameras' time."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
