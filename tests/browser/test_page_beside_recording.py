"""A page that is killed, or flooded, beside a recording: the records are those of a recording without one."""

from __future__ import annotations

import socket
import sys
import urllib.request
from collections.abc import Callable
from dataclasses import astuple, replace
from multiprocessing import active_children
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from page_rig import BY_HAND, TWIN, wait_until

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.twin import build_twin, load_twin_settings
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.dashboard.beside import dashboard_beside
from namod_ctl.core.records import Record
from namod_ctl.cycle.record import Equipment, Recorder, StopRule
from namod_ctl.store.run import RunStore

N_RECORDS = 120
N_LISTENERS = 100

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the page's process is made as on the telescope's host")


def recorded(folder: Path, name: str, after_first_records: Callable[[Path], None] = lambda run: None) -> list[Record]:
    """The records of one seed's recording; what is done to its page is done when some are there."""
    (folder / "six.toml").write_text(BY_HAND)
    (folder / "twin.toml").write_text(TWIN)
    config: InstrumentConfig = load_config(str(folder / "six.toml"))
    twin = build_twin(config, load_twin_settings(folder / "twin.toml"), 5)
    settings = replace(build_record_settings(config), pace_s=twin.telescope.pass_s / N_RECORDS)
    facet_ids = [facet.id for facet in config.facets]
    is_to_come = True
    with RunStore.create(folder / name, facet_ids, config.to_json(), "a test", twin.wall_clock) as run:
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        recorder = Recorder(equipment, twin.instrument, run, settings)

        def look(progress: object) -> None:
            nonlocal is_to_come
            if is_to_come and len(run.records()) >= N_RECORDS // 4:
                is_to_come = False
                after_first_records(run.path)

        reason = recorder.record(StopRule(n_records=N_RECORDS), look)
        assert reason == "all records wanted are there"
        return run.records()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    return recorded(tmp_path_factory.mktemp("alone"), "RUN")


def assert_same(records: list[Record], others: list[Record]) -> None:
    """To the last bit; NaN is like NaN."""
    np.testing.assert_equal([astuple(record) for record in records], [astuple(record) for record in others])


def test_page_that_is_killed_does_not_touch_the_recording(tmp_path: Path, undisturbed: list[Record]) -> None:
    pages = []

    def kill(run: Path) -> None:
        pages.append(dashboard_beside(run))
        with urllib.request.urlopen(pages[0].__enter__(), timeout=30.0) as answer:  # it serves
            assert answer.status == 200
        (process,) = active_children()
        process.kill()  # SIGKILL
        wait_until(lambda: not process.is_alive(), "it lives")

    records = recorded(tmp_path, "RUN", kill)
    pages[0].__exit__(None, None, None)
    assert_same(records, undisturbed)


def test_a_hundred_silent_listeners_do_not_touch_the_recording(tmp_path: Path, undisturbed: list[Record]) -> None:
    pages, listeners = [], list[socket.socket]()

    def flood(run: Path) -> None:
        pages.append(dashboard_beside(run))
        address = urlsplit(pages[0].__enter__())
        for _ in range(N_LISTENERS):
            connection = socket.create_connection((address.hostname or "", address.port or 0), timeout=30.0)
            connection.sendall(f"GET /events HTTP/1.1\r\nHost: {address.netloc}\r\n\r\n".encode())
            listeners.append(connection)
        for connection in listeners:
            assert connection.recv(12) == b"HTTP/1.1 200"  # all are listened to; none of them reads on

    try:
        records = recorded(tmp_path, "RUN", flood)
    finally:
        for connection in listeners:
            connection.close()
        pages[0].__exit__(None, None, None)
    assert_same(records, undisturbed)
