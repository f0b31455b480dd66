"""Stand-ins for drivers' modules, one per way in which a maker's library behaves; named by `driver_module`."""

from __future__ import annotations

import os
import sys
import textwrap
from pathlib import Path

WAYS = {
    "good": 'print("loud"); sys.stderr.write("noise"); return [FoundCamera("good", "ACME", "One", "17", "")]',
    "none": "return []",
    "missing": "raise ConfigError(\"needs acme: install it with pip install 'namod-ctl[acme]'\")",
    "raising": 'raise RuntimeError("0xdead")',
    "crashing": "os.kill(os.getpid(), signal.SIGSEGV)",
    "hanging": "time.sleep(3600)",
    "stubborn": "threading.Thread(target=time.sleep, args=(3600,)).start(); return []",
}


def write_drivers(folder: Path) -> dict[str, str]:
    """Module names by driver; the modules lie in `folder`, which goes onto the path of Python."""
    for way, body in WAYS.items():
        (folder / f"driver_{way}.py").write_text(
            textwrap.dedent(
                f"""
                import os, signal, sys, threading, time
                from namod_ctl.core.errors import ConfigError
                from namod_ctl.devices.cameras.found import FoundCamera

                def list_cameras():
                    {body}
                """
            )
        )
    sys.path.insert(0, os.fspath(folder))
    return {way: f"driver_{way}" for way in WAYS} | {"absent": "driver_that_is_not_there"}
