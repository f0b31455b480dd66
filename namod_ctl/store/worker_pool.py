"""Measuring many records on all cores, in order, in a way that ends cleanly."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, get_context, parent_process

import cv2

from namod_ctl.core.errors import StoreError
from namod_ctl.core.records import Record
from namod_ctl.store.measure_files import Measurer, MeasuringContext
from namod_ctl.store.namod_folder import RecordFiles

Task = tuple[int, RecordFiles]

_TASKS_IN_FLIGHT_PER_JOB = 3  # keeps every worker busy while one result is committed, and memory small

_measurer: Measurer | None = None  # of a worker process, set once when it starts


def measure_in_order(context: MeasuringContext, tasks: Sequence[Task], n_jobs: int) -> Generator[Record, None, None]:
    """Records of the tasks (index, files), in their order, measured by `n_jobs` processes; by this one if it is 1.

    Raises StoreError when a worker dies. Closing the generator, or an exception in it, ends the workers.
    """
    if n_jobs == 1:
        measurer = Measurer(context)
        for index, files in tasks:
            yield measurer.measure(index, files)
        return
    # spawn: a forked child would inherit locks of OpenCV's and the progress bar's threads in any state
    executor = ProcessPoolExecutor(n_jobs, get_context("spawn"), _start_worker, (context,))
    remaining = iter(tasks)
    in_flight: deque[Future[Record]] = deque()
    # Ctrl-C reaches all processes of a terminal; the workers inherit this mask, only we are interrupted
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        for _, (index, files) in zip(range(n_jobs * _TASKS_IN_FLIGHT_PER_JOB), remaining, strict=False):
            in_flight.append(executor.submit(_measure, index, files))
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        while in_flight:
            record = in_flight.popleft().result()
            for index, files in remaining:
                in_flight.append(executor.submit(_measure, index, files))
                break
            yield record
    except BrokenProcessPool as error:
        raise StoreError("a worker process died, perhaps for lack of memory: try again with --jobs 1") from error
    finally:
        executor.shutdown(cancel_futures=True)


def _start_worker(context: MeasuringContext) -> None:
    global _measurer  # the executor's only way to give a process something to keep
    cv2.setNumThreads(1)  # the cores are taken by the other workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _measurer = Measurer(context)


def _end_with_parent() -> None:
    """End this worker when the parent is gone: one that was killed cannot tell its workers to stop."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _measure(index: int, files: RecordFiles) -> Record:
    assert _measurer is not None
    return _measurer.measure(index, files)
