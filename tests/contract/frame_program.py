"""A program as observers write them: reads what the folder's `request.json` wants, and drops frames there.

It is a program of its own, on purpose without a line of the project: FITS by astropy, PNG and TIFF by Pillow.
"""

from __future__ import annotations

import contextlib
import io
import json
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from PIL import Image

Write = Callable[[Path, np.ndarray, float, str], None]
"""From a path without ending, the pixels, the exposure in s and the request."""

LOOK_S = 0.004


def write_fits(path: Path, pixels: np.ndarray, exposure_s: float, request: str) -> None:
    """Straight under its name: whoever reads must see himself when it is whole."""
    header = fits.Header({"EXPTIME": exposure_s, "NAMODREQ": request, "OBJECT": "Vega"})
    fits.PrimaryHDU(pixels, header).writeto(path.with_suffix(".fits"))


def write_png(path: Path, pixels: np.ndarray, exposure_s: float, request: str) -> None:
    """The picture (Pillow has red first), then its side file."""
    Image.fromarray(np.ascontiguousarray(pixels[..., ::-1]) if pixels.ndim == 3 else pixels).save(
        path.with_suffix(".png")
    )
    path.with_suffix(".json").write_text(json.dumps({"exposure_s": exposure_s, "request": request}))


def write_tiff(path: Path, pixels: np.ndarray, exposure_s: float, request: str) -> None:
    """The side file first, as lines; it does not say which request this is for."""
    path.with_suffix(".txt").write_text(f"exposure_s = {exposure_s!r}\n")
    Image.fromarray(pixels).save(path.with_suffix(".tif"))


class FrameProgram:
    """Answers every request when its exposure is over; `is_stubborn` also those that were replaced meanwhile.

    Attributes
    ----------
    n_to_lose
        So many answers from now on are not written.
    """

    def __init__(self, folder: Path, pixels: np.ndarray, write: Write, *, is_stubborn: bool) -> None:
        self.n_to_lose = 0
        self._folder, self._pixels, self._write, self._is_stubborn = folder, pixels, write, is_stubborn
        self._wanted = ""
        self._n_frames = 0
        self._is_over = threading.Event()
        self._threads = [threading.Thread(target=self._watch)]

    def __enter__(self) -> FrameProgram:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        for thread in self._threads:
            thread.join()

    def _watch(self) -> None:
        while not self._is_over.wait(LOOK_S):
            try:
                request = json.loads((self._folder / "request.json").read_text())
            except FileNotFoundError:
                continue
            if request["request"] != self._wanted:
                self._wanted = request["request"]
                worker = threading.Thread(target=self._answer, args=(request["request"], request["exposure_s"]))
                self._threads.append(worker)
                worker.start()

    def _answer(self, request: str, exposure_s: float) -> None:
        pixels = self.expose(exposure_s)
        if self._is_over.is_set() or (not self._is_stubborn and self._wanted != request):
            return
        if self.n_to_lose:
            self.n_to_lose -= 1
            return
        self._n_frames += 1
        with contextlib.suppress(FileNotFoundError):  # somebody took the disk away
            self._write(self._folder / f"frame_{self._n_frames:04d}_{request}", pixels, exposure_s, request)

    def expose(self, exposure_s: float) -> np.ndarray:
        """The pixels, when the exposure is over; at once at the end of the program."""
        self._is_over.wait(exposure_s)
        return self._pixels


def bytes_of(pixels: np.ndarray, ending: str) -> bytes:
    """A whole file of grey pixels of 8 bit, exposed for 0.01 s."""
    data = io.BytesIO()
    if ending == ".fits":
        fits.PrimaryHDU(pixels, fits.Header({"EXPTIME": 0.01})).writeto(data)
    else:
        Image.fromarray(pixels).save(data, {".png": "PNG", ".tif": "TIFF"}[ending])
    return data.getvalue()
