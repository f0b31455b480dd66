"""What listeners of the page are told, and who cannot disturb it."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dashboard_samples import TOKEN, new_campaign, new_run, record
from typer.testing import CliRunner

from namod_ctl.app.commands.dashboard import dashboard
from namod_ctl.app.dashboard.addresses import own_addresses
from namod_ctl.app.dashboard.beside import dashboard_beside
from namod_ctl.app.dashboard.feed import Feed
from namod_ctl.app.dashboard.guard import Rules
from namod_ctl.app.dashboard.server import build_server, listen
from namod_ctl.app.dashboard.state import Watched
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult


def sections(text: str) -> dict[str, Any]:
    """Sections in the text of server-sent events."""
    found = {}
    for block in text.strip().split("\n\n"):
        lines = dict(line.split(": ", 1) for line in block.split("\n"))
        if "event" in lines:
            found[lines["event"]] = json.loads(lines["data"])
    return found


def listening(path: Path, story: Callable[[Feed], Awaitable[None]]) -> None:
    async def run() -> None:
        feed = Feed(path)
        await feed.start()
        try:
            await asyncio.wait_for(story(feed), 20.0)
        finally:
            await feed.close()

    asyncio.run(run())


def test_listeners_are_told_everything_first_and_then_what_changes(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        n_facets = len(run.facet_ids)
        run.append([record(index, n_facets) for index in range(5)])

        async def story(feed: Feed) -> None:
            first, second = feed.events(), feed.events()
            for words in (first, second):
                await anext(words)
                said = sections(await anext(words))
                assert {"about", "standing", "now"} <= set(said)
                assert said["now"]["n_accepted"] == 5
            run.append([record(5, n_facets, RejectReason.NO_STAR), record(6, n_facets)])
            for words in (first, second):
                said = sections(await anext(words))
                assert "about" not in said
                assert (said["now"]["n_accepted"], said["now"]["n_rejected"]) == (6, 1)
                assert said["now"]["rejected"][0]["reason"] == "no star"

        listening(tmp_path / "R", story)


def test_listener_that_is_slow_gets_the_newest_and_no_backlog(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        n_facets = len(run.facet_ids)

        async def story(feed: Feed) -> None:
            quick, slow = feed.events(), feed.events()
            for words in (quick, slow):
                await anext(words)
                await anext(words)
            for index in range(30):
                run.append([record(index, n_facets)])
                while sections(await anext(quick)).get("now", {}).get("n_accepted") != index + 1:
                    pass
            said = sections(await anext(slow))
            assert said["now"]["n_accepted"] == 30

        listening(tmp_path / "R", story)


def test_nothing_is_read_while_nobody_listens(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:

        async def story(feed: Feed) -> None:
            words = feed.events()
            await anext(words)
            await anext(words)
            await words.aclose()
            await asyncio.sleep(0.1)  # the look under way ends
            assert feed._looking is not None
            assert feed._looking.done()
            run.append([record(0, len(run.facet_ids))])
            again = feed.events()
            await anext(again)
            assert sections(await anext(again))["now"]["n_accepted"] == 1

        listening(tmp_path / "R", story)


def test_a_cycle_is_followed_though_its_run_comes_after_the_last_word_of_the_campaign(tmp_path: Path) -> None:
    with new_campaign(tmp_path / "C") as store, Watched(store.path) as watched:
        for cycle in (1, 2):
            store.begin_cycle()
            assert "now" not in watched.look()
            with new_run(store.run_path(cycle)) as run:
                run.append([record(0, len(run.facet_ids))])
                assert json.loads(watched.look()["now"])["run"] == cycle
            store.save_cycle(replace(store.cycles()[-1], alignment_json=None, n_records=1))
            watched.look()


def test_new_cycle_of_a_campaign_is_followed(tmp_path: Path) -> None:
    with new_campaign(tmp_path / "C") as store, Watched(store.path) as watched:
        assert "now" not in watched.look()
        for number in (1, 2):
            store.begin_cycle()
            with new_run(store.run_path(number)) as run:
                run.append([record(index, len(run.facet_ids)) for index in range(number)])
            store.add_event("test", "a cycle")
            found = watched.look()
            now = json.loads(found["now"])
            assert (now["run"], now["n_accepted"]) == (number, number)
            assert [cycle["cycle"] for cycle in json.loads(found["cycles"])] == list(range(1, number + 1))
        assert watched.look() == {}


def test_commands_follow_the_state(tmp_path: Path) -> None:
    with new_campaign(tmp_path / "C") as store, Watched(store.path) as watched:

        def commands() -> set[str]:
            return set(json.loads((watched.look() or watched.everything())["standing"])["commands"])

        assert commands() == {"stop", "pause"}
        store.add_transition("recording", "paused", "pause", "")
        assert commands() == {"stop", "resume"}
        store.add_transition("previewing", "awaiting_approval", "ask", "")
        assert commands() == {"stop", "approve", "refuse"}
        store.add_transition("awaiting_approval", "held", "hold", "")
        assert commands() == set()
    with Watched(tmp_path / "C") as watched:  # nobody is at work any more
        standing = json.loads(watched.look()["standing"])
        assert (standing["is_running"], standing["commands"]) == (False, [])


def test_facet_map_holds_the_records_that_count(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run, Watched(tmp_path / "R") as watched:
        records = [record(index, len(run.facet_ids)) for index in range(4)]
        run.append([*records, record(4, len(run.facet_ids), RejectReason.NO_STAR)])
        watched.look()
        facet = watched.facet(run.facet_ids[2])
        assert facet is not None
        expected = [each.facet_intensity[2] / each.star_intensity for each in records]
        assert [sample[2] for sample in facet["samples"]] == pytest.approx(expected, rel=1e-4)
        arcmin = 60.0 * 180.0 / 3.141592653589793
        assert [sample[0] for sample in facet["samples"]] == pytest.approx(
            [each.theta_rad[0] * arcmin for each in records], rel=1e-4
        )


def test_a_thousand_connections_that_say_nothing_keep_nobody_out(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, most), most))
    with new_run(tmp_path / "R"):
        pass
    server = build_server(tmp_path / "R", Rules(TOKEN, is_loopback=True))
    silent: list[socket.socket] = []
    try:
        with listen("127.0.0.1", 0) as listening_socket:
            address = listening_socket.getsockname()
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listening_socket]})
            thread.start()
            try:
                for number in range(1000):
                    connection = socket.create_connection(address, timeout=10.0)
                    if number % 2:
                        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow:")
                    silent.append(connection)
                began_s = time.monotonic()
                with urllib.request.urlopen(f"http://127.0.0.1:{address[1]}/", timeout=10.0) as answer:
                    assert answer.status == 200
                assert time.monotonic() - began_s < 2.0
            finally:
                server.should_exit = True
                thread.join(20.0)
    finally:
        for connection in silent:
            connection.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))


def test_run_that_is_taken_away_is_said_and_the_page_goes_on(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        run.append([record(0, len(run.facet_ids))])
    with Watched(tmp_path / "R") as watched:
        assert json.loads(watched.look()["trouble"]) == ""
        (tmp_path / "R").rename(tmp_path / "elsewhere")
        assert str(tmp_path / "R") in json.loads(watched.look()["trouble"])
        new_run(tmp_path / "R").close()
        assert "replaced" in json.loads(watched.look()["trouble"])
        shutil.rmtree(tmp_path / "R")
        (tmp_path / "elsewhere").rename(tmp_path / "R")
        assert json.loads(watched.look()["trouble"]) == ""


def test_rough_look_shows_which_facets_are_off_before_there_is_an_estimate(tmp_path: Path) -> None:
    """Gaussian spots of 2 arcmin, recorded every 2 arcmin: their centres come out to half of that distance."""
    arcmin = math.radians(1.0 / 60.0)
    with new_run(tmp_path / "R") as run, Watched(tmp_path / "R") as watched:
        n = len(run.facet_ids)
        rng = np.random.default_rng(4)
        true_rad = rng.uniform(-8.0, 8.0, (n, 2)) * arcmin
        axis_rad = np.median(true_rad, axis=0)
        grid = [np.array([x, y]) * arcmin for x in range(-14, 15, 2) for y in range(-14, 15, 2)]
        for index, theta_rad in enumerate(grid):
            light = 0.01 + np.exp(-0.5 * np.sum((true_rad - theta_rad) ** 2, axis=1) / (2.0 * arcmin) ** 2)
            light[5] = 0.01 + 0.001 * rng.random()  # covered: it never shines
            run.append([replace(record(index, n), theta_rad=theta_rad, facet_intensity=light)])
        table = json.loads(watched.look()["facets"])["table"]
    assert table[5]["off_arcmin"] is None
    for facet, theta_rad in zip(table, true_rad, strict=True):
        if facet["off_arcmin"] is not None:
            expected = float(np.hypot(*(theta_rad - axis_rad))) / 2.0 / arcmin
            assert facet["off_arcmin"] == pytest.approx(expected, abs=1.0)


def test_dashboard_beside_a_recording_is_served_and_ends_with_it(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        with dashboard_beside(tmp_path / "R") as address:
            with urllib.request.urlopen(address, timeout=30.0) as answer:
                assert answer.status == 200
            run.append([record(0, len(run.facet_ids))])  # nobody is in the way
        with pytest.raises(urllib.error.URLError):
            urllib.request.urlopen(address, timeout=5.0)


BESIDE = """
import sys, time
from pathlib import Path
from namod_ctl.app.dashboard.beside import dashboard_beside
if __name__ == "__main__":
    with dashboard_beside(Path(sys.argv[1])) as address:
        print(address, flush=True)
        time.sleep(60.0)
"""


def is_served(address: str) -> bool:
    try:
        urllib.request.urlopen(address, timeout=5.0).close()
    except OSError:
        return False
    return True


def test_page_beside_a_program_that_is_killed_ends_with_it(tmp_path: Path) -> None:
    with new_run(tmp_path / "R"):
        pass
    (tmp_path / "beside.py").write_text(BESIDE)
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "beside.py"), str(tmp_path / "R")],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"NAMOD_CTL_TOKEN": "a-token-of-the-night"},
    ) as program:
        assert program.stdout is not None
        address = program.stdout.readline().strip()
        try:
            assert address.endswith("#token=a-token-of-the-night")
            with urllib.request.urlopen(address, timeout=30.0) as answer:
                assert answer.status == 200
        finally:
            program.kill()
    deadline_s = time.monotonic() + 20.0
    while is_served(address):
        assert time.monotonic() < deadline_s, "the page has outlived its program"


def test_token_of_the_environment_that_can_be_guessed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NAMOD_CTL_TOKEN", "short")
    with pytest.raises(ConfigError, match="NAMOD_CTL_TOKEN"), dashboard_beside(tmp_path):
        pass


def test_addresses_are_those_that_the_system_names() -> None:
    hostname = shutil.which("hostname")
    if hostname is None:
        pytest.skip("there is no program `hostname` to compare with")
    listed = subprocess.run([hostname, "-I"], capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("this `hostname` lists no addresses")
    expected = {address for address in listed.stdout.split() if ":" not in address}
    assert set(own_addresses()) <= expected
    assert bool(own_addresses()) == bool(expected)


def test_wrong_start_is_said_in_words(tmp_path: Path) -> None:
    import typer

    app = typer.Typer()
    app.command()(dashboard)
    (tmp_path / "empty").mkdir()
    for arguments, words in (
        ([str(tmp_path / "empty")], "neither a run nor a campaign"),
        ([str(tmp_path / "empty"), "--token", "short"], "at least"),
        ([str(tmp_path / "empty"), "--token", "with a blank in it"], "without blanks"),
    ):
        result = CliRunner().invoke(app, arguments)
        assert isinstance(result.exception, ConfigError)
        assert words in str(result.exception)


def test_address_in_use_is_said(tmp_path: Path) -> None:
    with listen("127.0.0.1", 0) as first, pytest.raises(ConfigError, match="in use"):
        listen("127.0.0.1", first.getsockname()[1])
    with pytest.raises(ConfigError, match="--host"):
        listen("192.0.2.1", 0)  # an address of the documentation, nobody's own


def test_legs_show_their_last_order_and_what_their_drive_said_last(tmp_path: Path) -> None:
    legs = [Leg(7, index) for index in range(4)]
    with new_campaign(tmp_path / "C") as store, Watched(store.path) as watched:
        assert json.loads(watched.look()["actuators"])["legs"] == []
        store.show_legs({legs[3]: DriveState(2e-3, False, False)})
        found = json.loads(watched.look()["actuators"])
        assert (found["cycle"], found["counts"], found["drives"]) == (None, {}, {"not homed": 1})
        orders = [MoveOrder(leg, 0.0, 1e-3) for leg in legs[:3]]
        ids = store.order(store.begin_cycle(), orders)
        store.show_legs(
            {
                legs[0]: DriveState(0.4e-3, True, True, (), 300.15),
                legs[1]: DriveState(math.nan, False, True, ("supply too low",)),
                legs[2]: "no answer from module 5",
            }
        )
        by_leg = {leg["leg"]: leg for leg in json.loads(watched.look()["actuators"])["legs"]}
        assert (by_leg[1]["position_mm"], by_leg[1]["target_mm"], by_leg[1]["drive"]) == (0.4, 1.0, "moves, 27 °C")
        assert by_leg[2]["position_mm"] is None
        assert "supply too low" in by_leg[2]["drive"]
        assert "no answer from module 5" in by_leg[3]["drive"]
        assert by_leg[4]["drive"] == "stands still, not homed"
        store.result(ids[0], MoveResult(orders[0], MoveOutcome.ARRIVED, 1e-3))
        store.show_legs({legs[0]: DriveState(1e-3, False, True)})
        found = json.loads(watched.look()["actuators"])
    assert [leg["is_bad"] for leg in found["legs"]] == [False, True, True, True]
    assert found["drives"] == {"well and still": 1, "with a fault": 1, "silent": 1, "not homed": 1}
