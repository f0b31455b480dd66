"""The page of a small campaign, served here and looked at with Debian's Chromium."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page

from namod_ctl.app.dashboard.guard import Rules
from namod_ctl.app.dashboard.server import build_server, listen
from namod_ctl.store.campaign import CampaignStore

TOKEN = "a token for the tests"
BROWSER = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
BROWSER += ("--disable-component-update", "--disable-sync")

# Six of FACT's facets on two lines, and small cameras: a cycle takes seconds.
CONFIG = """
extends = "mini_fact"
telescope = { name = "Six facets", focal_length_m = 4.889 }
reflector.layout = { width_m = 0.605, spacing_m = 0.620, inner_radius_m = 0.30, outer_radius_m = 0.70 }
mount = { radius_m = 0.295, pitch_mm_per_turn = 1.0, travel_limit_mm = 5.0, backlash_um = 10.0 }
star_camera = { columns = 400, rows = 320 }
reflector_camera = { columns = 128, rows = 96, plate_scale_mdeg_per_px = 240.0 }

[actuators]
step_um = 3.0
sign = 1
range_mm = [-5.0, 5.0]
speed_mm_per_s = 1.0
acceleration_mm_per_s2 = 5.0
motion = { approach_mm = 0.05, settle_s = 0.1 }

[[actuators.buses]]
name = "south"
url = "/dev/ttyUSB0"
protocol = "tmcl"
baud = 115200
max_moving = 4
facet_ids = [1, 2, 3, 4, 5, 6]
first_address = 1
axes_per_address = 3
"""
TWIN = """
reflector = { misalignment_arcmin = 2.0 }
telescope = { radius_deg = 0.15, spacing_arcmin = 1.5 }
"""


BY_HAND = CONFIG.split("[actuators]")[0]

SIZES = {"phone": (390, 844), "laptop": (1366, 768), "wide": (2560, 1440)}

OVERLAPS = """() => {
  const boxes = [...document.querySelectorAll('section, header')]
    .filter((e) => e.offsetParent !== null || e.tagName === 'HEADER')
    .map((e) => [e.querySelector('h1, h2').id, e.getBoundingClientRect()]);
  const found = [];
  for (const [i, [a, p]] of boxes.entries()) for (const [b, q] of boxes.slice(i + 1)) {
    const w = Math.min(p.right, q.right) - Math.max(p.left, q.left);
    const h = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
    if (w > 1 && h > 1) found.push(`${a} over ${b}`);
  }
  for (const e of document.querySelectorAll('section *')) {
    if (e.closest('.scroll') || e.closest('svg') || e.matches('.unseen, .unseen *') || !e.offsetParent) continue;
    const p = e.getBoundingClientRect(), q = e.closest('section').getBoundingClientRect();
    if (p.width && (p.right > q.right + 1 || p.left < q.left - 1)) found.push(`${e.tagName} ${e.id} sticks out`);
  }
  return found;
}"""

NOT_RED = """() => [...document.querySelectorAll('body *')].flatMap((e) => {
  const style = getComputedStyle(e);
  return [style.color, style.backgroundColor, style.fill, style.stroke]
    .map((c) => c.match(/[\\d.]+/g)?.map(Number) ?? [])
    .filter(([r, g, b, a]) => a !== 0 && (g > 0.75 * r || b > 0.75 * r) && r + g + b > 0);
})"""


@contextmanager
def aligning(folder: Path, *options: str, config: str = CONFIG) -> Iterator[Path]:
    """A campaign that another process works on; ends with the block, if it has not ended before."""
    (folder / "six.toml").write_text(config)
    (folder / "twin.toml").write_text(TWIN)
    campaign = folder / "CAMPAIGN"
    arguments = ["align", "--config", str(folder / "six.toml"), "--twin-settings", str(folder / "twin.toml")]
    arguments += ["--out", str(campaign), "--seed", "3", "--records", "80", *options]
    with (folder / "align.txt").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", "from namod_ctl.app.cli import main; main()", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        try:
            yield campaign
        finally:
            process.kill()
            process.wait()


def wait_until(is_so: Callable[[], bool], what: str, within_s: float = 60.0) -> None:
    """Wait for another process; fails with `what` when it takes too long."""
    deadline_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < deadline_s, what
        time.sleep(0.05)


def state_of(campaign: Path) -> str | None:
    """Where the campaign stands; None while there is none."""
    if not (campaign / "campaign.sqlite").exists():
        return None
    with CampaignStore.open(campaign) as store:
        return store.last_state()


@contextmanager
def served(path: Path, port: int = 0) -> Iterator[str]:
    """The page of the run or campaign, at an address of this computer."""
    server = build_server(path, Rules(TOKEN, is_loopback=True))
    with listen("127.0.0.1", port) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{listening.getsockname()[1]}/"
        finally:
            server.should_exit = True
            thread.join(20.0)
            assert not thread.is_alive()


class Watcher:
    """What a page complained of, and whom it asked."""

    def __init__(self, page: Page) -> None:
        self.complaints: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda message: self.complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
