"""A camera simulator that others wrote (PyPI: alpaca-simulators) on the wire: a small sensor and a sky of one star."""

from __future__ import annotations

import math
import sqlite3
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from foreign_programs import ForeignServer, free_port

COLUMNS, ROWS = 160, 120
SENSOR_COLUMNS, SENSOR_ROWS = 320, 240
SHORTEST_S, LONGEST_S = 0.001, 60.0
BIAS_ADU = 300.0  # cabaret's, with which the simulator draws
CATALOGUE = "stars.sqlite"
_POINTING_DEG = (15.0, 20.0)
_STAR_MAG = 7.0
ARCSEC_PER_PX = 0.2578  # 10 um at 8 m
STAR_OFFSET_PX = (24.0, -15.0)
"""Where the star stands, to the east and to the north of where the telescope points: north is up, east is left."""


def alpaca_server(
    folder: Path, cameras: Sequence[Mapping[str, Any]] = ({},), drift_arcsec_per_s: float = 0.0
) -> ForeignServer:
    """The simulator, not yet started. Skips where it is not installed.

    Parameters
    ----------
    cameras
        Its cameras, each with the properties that are not the simulator's or this module's own.
    drift_arcsec_per_s
        Its telescope moves north so fast; where it does not move, frames of the same exposure are copies of the first.
    """
    spec = find_spec("alpaca_simulators")
    if spec is None or spec.origin is None:
        pytest.skip("alpaca-simulators is not installed (pip install alpaca-simulators)")
    config = yaml.safe_load((Path(spec.origin).parent / "config" / "template.yaml").read_text())
    properties = {
        **config["devices"]["camera"][0],
        "cameraxsize": SENSOR_COLUMNS,
        "cameraysize": SENSOR_ROWS,
        "numx": SENSOR_COLUMNS,
        "numy": SENSOR_ROWS,
        "exposuremin": SHORTEST_S,
        "exposuremax": LONGEST_S,
        "fullwellcapacity": 65535,
        "gains": [],  # its own list counts from 0 where it is set and from 1 where it is read
    }
    config["devices"]["camera"] = {number: properties | dict(own) for number, own in enumerate(cameras)}
    catalogue = folder / CATALOGUE
    with sqlite3.connect(catalogue) as connection:
        connection.execute("CREATE TABLE gaia_sources (ra REAL, dec REAL, phot_g_mean_mag REAL)")
        east_deg, north_deg = (offset * ARCSEC_PER_PX / 3600.0 for offset in STAR_OFFSET_PX)
        star = (_POINTING_DEG[0] + east_deg / math.cos(math.radians(_POINTING_DEG[1])), _POINTING_DEG[1] + north_deg)
        connection.execute("INSERT INTO gaia_sources VALUES (?, ?, ?)", (*star, _STAR_MAG))
    connection.close()
    config["devices"]["telescope"][0] |= {
        "rightascension": _POINTING_DEG[0] / 15.0,
        "declination": _POINTING_DEG[1],
        "tracking": True,
        "declinationrate": drift_arcsec_per_s,
        "atpark": False,
        "athome": False,
    }
    config["tap_source"] = str(catalogue)
    config_path = folder / "simulator.yaml"
    config_path.write_text(yaml.safe_dump(config))
    port = free_port()
    command = [sys.executable, "-m", "alpaca_simulators.run_simulator"]
    command += ["--host", "127.0.0.1", "--port", str(port), "--config", str(config_path)]
    return ForeignServer(command, port, folder / "simulator.log", {"OMP_NUM_THREADS": "1"})
