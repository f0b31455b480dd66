"""Lives of the program: each is the real command line in a process that ends by itself or is killed.

A process of its own has all modules imported and forks one life after another, so that a life costs no start of Python.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

N_RECORDS = 80
SEED = 3

# Six of FACT's facets, three on a line of TMCL modules and three on one of Zaber controllers; small cameras.
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
facet_ids = [1, 2, 3]
first_address = 1
axes_per_address = 3

[[actuators.buses]]
name = "north"
url = "/dev/ttyUSB1"
protocol = "zaber"
baud = 115200
max_moving = 4
facet_ids = [4, 5, 6]
axes_per_address = 3
"""
TWIN = """
reflector = { misalignment_arcmin = 2.0 }
telescope = { radius_deg = 0.15, spacing_arcmin = 1.5 }
"""


# A life stays a zombie until the next one begins: its id belongs to nobody else when it is killed too late.
_NURSERY = """
import importlib, json, os, sys
from namod_ctl.app.cli import main
for name in ("align", "control", "status"):
    importlib.import_module("namod_ctl.app.commands." + name)
print("ready", flush=True)
dead = []
for line in sys.stdin:
    given = json.loads(line)
    while dead:
        os.waitpid(dead.pop(), 0)
    pid = os.fork()
    if pid == 0:
        nothing = os.open(os.devnull, os.O_RDONLY)
        output = os.open(given["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        for file, number in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(file, number)
        sys.stdin = open(0, closefd=False)
        sys.argv = ["namod-ctl", *given["arguments"]]
        main()
        sys.exit(0)
    print(pid, flush=True)
    end = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    print(end.si_status if end.si_code == os.CLD_EXITED else -end.si_status, flush=True)
    dead.append(pid)
"""


class Nursery:
    """Gives birth to lives; a context manager. One life at a time.

    Attributes
    ----------
    output
        File to which all lives print.
    """

    def __init__(self, output: Path) -> None:
        self.output = output
        self._life: Life | None = None
        self._process = subprocess.Popen(
            [sys.executable, "-c", _NURSERY],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,  # so that nothing is read ahead of what `select` looks at
            env=os.environ | {"OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        )
        assert self._read() == "ready"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._life is not None and not self.has_news():
            os.kill(self._life.pid, signal.SIGKILL)  # a test has failed meanwhile
        self._process.communicate()

    def begin(self, *arguments: str) -> Life:
        """A process that runs `namod-ctl` with these arguments."""
        assert self._process.stdin is not None
        if self._life is not None:
            self._life.kill()  # left behind by a test that has failed
        line = json.dumps({"arguments": arguments, "output": str(self.output)}) + "\n"
        self._process.stdin.write(line.encode())
        self._life = Life(self, int(self._read()))
        return self._life

    def run(self, *arguments: str) -> int:
        """Exit code of a life that nobody kills."""
        return self.begin(*arguments).exit_code()

    def printed(self) -> str:
        """By all lives so far."""
        return self.output.read_text()

    def has_news(self) -> bool:
        """Has the life that was begun last ended?"""
        return bool(select.select([self._process.stdout], [], [], 0.0)[0])

    def read_exit_code(self) -> int:
        """Of the life that was begun last, when it has ended; once."""
        self._life = None
        return int(self._read())

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().decode().strip()


class Life:
    """One process that runs the command line."""

    def __init__(self, nursery: Nursery, pid: int) -> None:
        self._nursery = nursery
        self.pid = pid

    def has_ended(self) -> bool:
        """Is it over, without anybody having waited for it?"""
        return self._nursery.has_news()

    def kill(self) -> int:
        """Its exit code: that of SIGKILL, unless it ended before."""
        os.kill(self.pid, signal.SIGKILL)
        return self.exit_code()

    def exit_code(self) -> int:
        """When it has ended."""
        return self._nursery.read_exit_code()


def begin(folder: Path, *more: str, config_text: str = CONFIG) -> tuple[Path, tuple[str, ...]]:
    """Where a campaign will be, and the command that begins it."""
    config, twin, path = folder / "config.toml", folder / "twin.toml", folder / "CAMPAIGN"
    config.write_text(config_text)
    twin.write_text(TWIN)
    options = ("--config", config, "--twin-settings", twin, "--out", path, "--seed", SEED, "--records", N_RECORDS)
    return path, ("align", *map(str, options), *more)
