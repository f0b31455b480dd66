"""The facet editor on a real socket, over a twin picture of FACT's reflector."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import uvicorn

sys.path.append(str(Path(__file__).parents[1] / "imaging"))

from reflector_pictures import TrueCamera, instrument_of, true_outlines, true_pixels, twin_picture

from namod_ctl.app.commands.instruct import read_picture
from namod_ctl.app.facet_editor.server import build_app
from namod_ctl.app.facet_editor.workbench import open_workbench

TOKEN = "a-token-for-tests"
CAMERA = TrueCamera((0.08, -0.05, 0.04), (0.015, -0.01, 0.03), 880.0)
CONFIG = "fact"


@dataclass(frozen=True)
class Editor:
    """A running editor: its address, the file it writes, and where facets really are in its picture."""

    host: str
    out: Path
    centres_px: dict[int, np.ndarray]
    outlines_px: dict[int, np.ndarray]


def write_picture(folder: Path) -> Path:
    """The twin's picture as a PNG file."""
    instrument = instrument_of(CONFIG, folder)
    path = folder / "reflector.png"
    cv2.imwrite(str(path), twin_picture(instrument, CAMERA, seed=2))
    return path


def truth(folder: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """True centres (2,) and outlines by facet id."""
    instrument = instrument_of(CONFIG, folder)
    places = true_pixels(instrument.reflector.positions_m, instrument, CAMERA)
    return dict(zip(instrument.reflector.ids, places, strict=True)), true_outlines(instrument, CAMERA)


@contextmanager
def running_editor(folder: Path) -> Iterator[Editor]:
    """The editor until the block ends; it listens before the block begins."""
    picture = write_picture(folder)
    out = folder / "map.csv"
    listener = socket.create_server(("127.0.0.1", 0))
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    bench = open_workbench(CONFIG, picture, read_picture(picture), out)
    app = build_app(bench, TOKEN)
    server = uvicorn.Server(uvicorn.Config(app, ws="none", lifespan="off", log_level="error", access_log=False))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield Editor(host, out, *truth(folder))
    finally:
        deadline = time.monotonic() + 30.0
        while not server.started and time.monotonic() < deadline:
            thread.join(0.01)  # a server that is told to end before it has begun does not
        server.should_exit = True
        thread.join()
        listener.close()
