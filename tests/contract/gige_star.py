"""A GigE Vision camera that sees the star of a fake night: Aravis' fake, run by this program, with that sky in it.

Started by tests as a process of its own, so that it can be killed: `python gige_star.py IP SERIAL_NUMBER`.
"""

from __future__ import annotations

import ctypes
import signal
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "unit/cycle"))
sys.path.append(str(Path(__file__).parents[1] / "unit/imaging"))
sys.path.append(str(Path(__file__).parents[1] / "unit/reconstruction"))

from fake_night import Night

READOUT_S = 0.0025
"""The fake looks every 5 ms for a trigger: so long after the exposure's end, on average, its frame is made."""

FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


def main(ip: str, serial_number: str) -> None:
    aravis = ctypes.CDLL("libaravis-0.8.so.0")
    aravis.arv_gv_fake_camera_new.restype = ctypes.c_void_p
    aravis.arv_gv_fake_camera_get_fake_camera.restype = ctypes.c_void_p
    aravis.arv_buffer_get_data.restype = ctypes.c_void_p
    night, rng = Night(), np.random.default_rng(7)
    night.star.render(time.monotonic(), 0.04, rng)  # the first takes longer

    def fill(buffer: int, _: int, exposure_us: int, _gain: int, _format: int) -> None:
        exposure_s = exposure_us / 1e6
        frame = night.star.render(time.monotonic() - READOUT_S - exposure_s / 2.0, exposure_s, rng)
        address = aravis.arv_buffer_get_data(ctypes.c_void_p(buffer), None)
        ctypes.memmove(address, np.ascontiguousarray(frame).ctypes.data, frame.size)

    pattern = FillPattern(fill)
    camera = aravis.arv_gv_fake_camera_new(ip.encode(), serial_number.encode())
    inside = ctypes.c_void_p(aravis.arv_gv_fake_camera_get_fake_camera(ctypes.c_void_p(camera)))
    aravis.arv_fake_camera_set_fill_pattern(inside, pattern, None)
    signal.pause()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
