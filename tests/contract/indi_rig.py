"""INDI's own server and camera simulators (Debian: indi-bin) on the wire, with one star in the middle of their sky."""

from __future__ import annotations

import os
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from foreign_programs import ForeignServer, free_port

CAMERA, OTHER_CAMERA = "CCD Simulator", "Guide Simulator"
COLUMNS, ROWS = 160, 120
SENSOR_COLUMNS, SENSOR_ROWS = 1280, 1024  # what the simulator has unless it is told otherwise
SHORTEST_S, LONGEST_S = 0.01, 3600.0
STAR_PX = (COLUMNS / 2.0, ROWS / 2.0)
"""Where the simulator draws a star that stands where it looks, in a frame that is centred on the sensor."""
WHOLE_PX = 1.1
"""It draws in whole pixels and looks near the pole: which side of the middle the star falls on, the hour decides."""

_STAR_MAG = -3.0
_POLLING = (
    "<newNumberVector device='{0}' name='POLLING_PERIOD'><oneNumber name='PERIOD_MS'>10</oneNumber></newNumberVector>"
)
_CATALOGUE = f"""#!/bin/sh
# stands in for the star catalogue that the simulators ask: gsc -c RA DEC ...
echo "0000000001 $2 $3 0.1 {_STAR_MAG} 0.1 0 0 0000 0 0.0 0"
"""


class IndiServer(ForeignServer):
    """The server with camera simulators behind a telescope of 1 m."""

    def start(self) -> None:
        """Start it, connect its cameras and tell them of the telescope, with INDI's own tool."""
        super().start()
        for camera in (CAMERA, OTHER_CAMERA):
            for setting in ("CONNECTION.CONNECT=On", "SCOPE_INFO.FOCAL_LENGTH;APERTURE=1000;200"):
                command = ["indi_setprop", "-p", str(self.port), "-t", "10", f"{camera}.{setting}"]
                subprocess.run(command, check=True, timeout=30)


def indi_server(folder: Path) -> IndiServer:
    """The server with two cameras, not yet started. Skips where it is not installed."""
    for program in ("indiserver", "indi_simulator_ccd", "indi_simulator_guide", "indi_setprop"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed (apt install indi-bin)")
    if find_spec("indipyclient") is None:
        pytest.skip("indipyclient is not installed (pip install 'namod-ctl[indi]')")
    (folder / ".indi").mkdir()
    for camera in (CAMERA, OTHER_CAMERA):
        config = f"<INDIDriver>{_POLLING.format(camera)}</INDIDriver>"
        (folder / ".indi" / f"{camera}_config.xml").write_text(config)
    (folder / "bin").mkdir()
    (folder / "bin" / "gsc").write_text(_CATALOGUE)
    (folder / "bin" / "gsc").chmod(0o755)
    port = free_port()
    command = ["indiserver", "-p", str(port), "-u", str(folder / "indi.sock")]
    command += ["indi_simulator_ccd", "indi_simulator_guide"]
    environment = {"HOME": str(folder), "PATH": f"{folder / 'bin'}:{os.environ['PATH']}"}
    return IndiServer(command, port, folder / "indiserver.log", environment)
