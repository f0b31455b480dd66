"""The page of the focus aid: what it is told, who may ask it, and that the loop with the camera never waits for it."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import active_children
from typing import Any

import cv2
import numpy as np
import pytest
from focus_samples import ARCMIN_PER_PX, SHORTEST_S, chosen_camera, look_at, show, star_frame
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.app.dashboard.guard import Rules
from namod_ctl.app.focus_page.beside import focus_page_beside
from namod_ctl.app.focus_page.board import SHOWN_S, Board
from namod_ctl.app.focus_page.cutout import LARGEST_PICTURE_PX, cutout, cutout_side_px
from namod_ctl.app.focus_page.frame_news import news_of
from namod_ctl.app.focus_page.news import FocusNews, packed, unpacked
from namod_ctl.app.focus_page.server import OF_THE_LIVE_PAGE, build_app
from namod_ctl.app.focus_page.trend import Trend, trend
from namod_ctl.app.views.camera_views import Look
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.focus import FocusCourse, read_focus
from namod_ctl.imaging.exposure import ExposureVerdict

HOST = "127.0.0.1:8766"
NEWS = FocusNews(0.0, 12.0, 11.0, ARCMIN_PER_PX, 0.7, 0.04, "")


@pytest.mark.parametrize("every_s", [0.05, 0.25, 3.0])  # fast cameras, the terminal's pace, long exposures
def test_trend_tells_where_a_noisy_size_goes(every_s: float) -> None:
    """A lens that is turned by a fifth of the size in 3 s (or in 4 frames), seen with 1 % of noise."""
    rng = np.random.default_rng(1)
    times_s = every_s * np.arange(60)
    turn = 0.2 / max(3.0, 3.0 * every_s)
    for rate, expected in ((-turn, Trend.BETTER), (turn, Trend.WORSE), (0.0, Trend.STEADY)):
        told = [
            trend(list(times_s), list(20.0 * np.exp(rate * times_s + rng.normal(0.0, 0.01, times_s.shape))))
            for _ in range(50)
        ]
        assert told.count(expected) >= 40, (rate, told)
        opposite = {Trend.BETTER: Trend.WORSE, Trend.WORSE: Trend.BETTER}.get(expected)
        assert opposite not in told


def test_trend_forgets_what_was_before() -> None:
    """Through the focus and out again: what counts is the last seconds."""
    times_s = [0.25 * i for i in range(80)]
    sizes = [10.0 + abs(time_s - 10.0) for time_s in times_s]
    assert trend(times_s[:36], sizes[:36]) is Trend.BETTER
    assert trend(times_s, sizes) is Trend.WORSE
    assert trend(times_s[:3], sizes[:3]) is None


@pytest.mark.parametrize(("x_px", "y_px"), [(250.0, 200.0), (3.0, 476.0), (636.0, 2.0)])
@pytest.mark.parametrize("kind", ["grey8", "grey16", "colour8"])
def test_cutout_holds_the_star_and_not_the_hot_pixel(x_px: float, y_px: float, kind: str) -> None:
    frame = star_frame(12.0, x_px=x_px, y_px=y_px)
    full_scale_adu = 255.0
    if kind == "grey16":
        frame, full_scale_adu = frame.astype(np.uint16) * 16, 4095.0
    elif kind == "colour8":
        frame = np.repeat(frame[:, :, None], 3, axis=2)
    data, side = cutout(frame, cutout_side_px(12.0), full_scale_adu)
    assert side == 64
    assert len(data) < 20_000
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (64, 64)
    left, top = min(max(x_px - 32.0, 0.0), 640.0 - 64.0), min(max(y_px - 32.0, 0.0), 480.0 - 64.0)
    light = np.maximum(image.astype(float) - 128.0, 0.0)
    row, column = np.unravel_index(np.argmax(cv2.GaussianBlur(light, (0, 0), 2.0)), light.shape)
    assert math.hypot(column + left - x_px, row + top - y_px) < 4.0
    assert image.max() > 230  # brightened
    assert np.median(image) < 60


def test_cutout_of_a_huge_star_is_small_enough_to_send() -> None:
    frame = np.random.default_rng(1).integers(0, 255, (1920, 2560), dtype=np.uint8)  # nothing packs worse
    data, side = cutout(frame, cutout_side_px(600.0), 255.0)
    assert side == 1920
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (LARGEST_PICTURE_PX,) * 2
    assert len(data) < 150_000


def test_a_star_stays_in_a_cutout_of_five_to_ten_times_its_size() -> None:
    for diameter_px in (13.0, 20.0, 77.0):
        assert 5.0 <= cutout_side_px(diameter_px) / diameter_px < 10.0
    assert cutout_side_px(math.nan, 128) == 128  # clouds: the picture keeps its scale


def test_news_tell_the_size_and_what_to_do() -> None:
    chosen = chosen_camera()

    def told(look: Look, *, is_exposure_given: bool = False) -> FocusNews:
        reading = None if look.exposure is None else read_focus(look.exposure.image, chosen.model, chosen.star_size_rad)
        return news_of(1.0, look, reading, 9.0, chosen, is_exposure_given=is_exposure_given)

    good = told(look_at(star_frame(12.0)))
    assert good.size_px == pytest.approx(12.0, rel=0.02)
    assert good.arcmin_per_px == pytest.approx(ARCMIN_PER_PX)
    assert (good.best_px, good.exposure_s, good.warning) == (9.0, 0.04, "")
    burnt = star_frame(12.0, peak_adu=2000.0)
    assert "--exposure" in told(look_at(burnt, ExposureVerdict.SATURATED), is_exposure_given=True).warning
    assert "trying a shorter" in told(look_at(burnt, ExposureVerdict.SATURATED)).warning
    assert "fainter star" in told(look_at(burnt, ExposureVerdict.SATURATED, SHORTEST_S)).warning
    dark = told(look_at(star_frame(12.0, peak_adu=0.0)))
    assert (dark.size_px, dark.peak_share) == (None, None)
    assert "No star" in dark.warning
    lost = told(Look(None, None, None, "lost 1 s ago; attempt 1 of 6"))
    assert (lost.size_px, lost.exposure_s) == (None, None)
    assert "attempt 1 of 6" in lost.warning


@given(st.binary(max_size=200), st.text(max_size=50), st.floats(0.1, 1e4))
def test_messages_arrive_as_they_were_sent(picture: bytes, warning: str, size_px: float) -> None:
    news = replace(NEWS, size_px=size_px, warning=warning)
    assert unpacked(packed(news, picture)) == (news, picture)


def content(text: str) -> Any:
    return json.loads(text.split("data: ", 1)[1])


def test_pages_get_all_first_and_then_what_is_new() -> None:
    async def story() -> None:
        board = Board("star")
        for at_s in range(5):
            board.add(replace(NEWS, at_s=float(at_s)), b"")
        events = board.events()
        assert content(await anext(events))["camera"] == "star"
        assert [time_s for time_s, _ in content(await anext(events))["course"]] == [0.0, 1.0, 2.0, 3.0, 4.0]
        board.add(replace(NEWS, at_s=5.0, size_px=None), b"")
        board.add(replace(NEWS, at_s=6.0, size_px=10.0, picture_px=64), b"a picture")
        news = content(await anext(events))  # slow: both at once, and the last counts
        assert news["course"] == [[5.0, None], [6.0, 10.0]]
        assert (news["size_px"], news["picture"]) == (10.0, {"number": 1, "width_px": 64})
        board.add(replace(NEWS, at_s=SHOWN_S + 5.5), b"")
        late = board.events()
        await anext(late)
        assert [time_s for time_s, _ in content(await anext(late))["course"]] == [6.0, SHOWN_S + 5.5]
        waiting = asyncio.ensure_future(anext(late, None))
        await asyncio.sleep(0)
        board.end()
        assert await asyncio.wait_for(waiting, 5.0) is None

    limited(story())


def limited(story: Awaitable[None]) -> None:
    async def run() -> None:
        await asyncio.wait_for(story, 20.0)

    asyncio.run(run())


@contextmanager
def asked(on_end: Callable[[], None] = lambda: None) -> Iterator[tuple[TestClient, socket.socket]]:
    """The page's application, and the end of the loop that tells it."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        page = build_app(Board("star"), theirs, Rules("a token nobody knows", is_loopback=True), on_end)
        with TestClient(page, base_url=f"http://{HOST}") as client:
            yield client, ours


def test_nobody_can_send_anything_nor_ask_by_another_name() -> None:
    with asked() as (client, _):
        for name in ("", *OF_THE_LIVE_PAGE, "focus.js", "focus.css", "curve.js"):
            answer = client.get(f"/{name}")
            assert answer.status_code == 200, name
            assert "default-src 'none'" in answer.headers["content-security-policy"]
        for name in ("page.html", "server.py", "..%2Fserver.py", "frame/0/star/1"):  # no picture has come
            assert client.get(f"/{name}").status_code == 404, name
        own = {"origin": f"http://{HOST}", "content-type": "application/json"}
        for method in ("POST", "PUT", "DELETE"):
            assert client.request(method, "/", headers=own).status_code == 401
        assert client.get("/", headers={"host": "evil.example"}).status_code == 421  # DNS rebinding
        assert client.get("/", headers={"host": "192.0.2.7:8766"}).status_code == 421  # served to this computer only


def test_page_ends_with_the_loop_that_tells_it() -> None:
    ended: list[bool] = []
    with asked(lambda: ended.append(True)) as (client, ours):
        ours.send(packed(replace(NEWS, picture_px=64), b"a picture"))
        ours.close()
        with client.stream("GET", "/events") as events:
            text = "".join(events.iter_text())  # ends
        assert client.get("/frame/0/star/1").content == b"a picture"
    assert "event: about" in text
    assert ended == [True]


def test_loop_never_waits_for_its_page(capsys: pytest.CaptureFixture[str]) -> None:
    """Stopped as by a debugger it hears nothing, killed neither: the loop goes on, and says so once."""
    chosen, course = chosen_camera(), FocusCourse()
    looks = [look_at(star_frame(size_px)) for size_px in (12.0, 14.0)]
    reading = read_focus(star_frame(12.0), chosen.model, chosen.star_size_rad)
    with focus_page_beside("star", "127.0.0.1", 0) as page:
        show(page, 0.0, course, looks[0], chosen)
        (process,) = active_children()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGSTOP)
        started_s = time.monotonic()
        for i in range(400):  # 400 pictures: more than a socket takes
            page.show(0.25 * i, looks[i % 2], reading, course.best_px, chosen, is_exposure_given=False)
        assert time.monotonic() - started_s < 20.0
        assert capsys.readouterr().err == ""
        process.kill()
        process.join(20.0)
        for _ in range(3):
            show(page, 0.0, course, looks[0], chosen)
        assert capsys.readouterr().err.count("goes on") == 1


def command(*arguments: str) -> subprocess.Popen[str]:
    code = "import sys; from namod_ctl.app.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-u", "-c", code, "camera", "focus", "star", "--twin", "--config", "mini_fact", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def news_from(address: str, n: int) -> list[Any]:
    """The first news of a page."""
    found = []
    with urllib.request.urlopen(f"{address}events", timeout=30.0) as answer:
        is_news = False
        while len(found) < n:
            line = answer.readline().decode()
            assert line, "it ended"
            if line.startswith("data: ") and is_news:
                found.append(json.loads(line.removeprefix("data: ")))
            is_news = line == "event: news\n"
    return found


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_command_and_page_end_together(sent: signal.Signals) -> None:
    """Ctrl-C ends both in order; when the command is killed its page does not stay behind."""
    with command("--page", "--port", "0") as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        first, *_, last = news_from(address, 5)
        assert last["at_s"] > first["at_s"]
        assert 0.0 < last["best_px"] <= first["best_px"]
        with urllib.request.urlopen(f"{address}frame/0/star/1", timeout=30.0) as answer:
            assert answer.read(3) == b"\xff\xd8\xff"  # JPEG
        process.send_signal(sent)
        output, errors = process.communicate(timeout=30.0)
    if sent is signal.SIGINT:
        assert (process.returncode, errors) == (0, "")
        assert "sharpest" in output
    deadline_s = time.monotonic() + 20.0
    while True:
        try:
            with urllib.request.urlopen(address, timeout=5.0):
                assert time.monotonic() < deadline_s, "it serves still"
        except OSError:
            break
        time.sleep(0.05)


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["camera", "focus", "star", "--twin", "--config", "mini_fact", *arguments])


def test_a_page_for_the_network_is_warned_of() -> None:
    told = run("--page", "--port", "0", "--host", "0.0.0.0", "--frames", "2")
    assert told.exit_code == 0, told.output
    assert "WARNING: --host 0.0.0.0" in told.stderr
    assert f"http://{socket.gethostname()}:" in told.stdout


def test_what_cannot_be_served_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        failed = run("--page", "--port", str(taken.getsockname()[1]), "--frames", "1").exception
    assert isinstance(failed, ConfigError)
    assert "in use" in str(failed)
    failed = run("--port", "0", "--frames", "1").exception
    assert isinstance(failed, ConfigError)
    assert "--page" in str(failed)
