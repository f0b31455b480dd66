"""One record measured: a 2560 x 1920 star frame and a 1024 x 768 x 3 reflector frame with 30 facets, in one thread.

Beside it, in the same run and on the same frames: sep (background, extract, winpos) plus scipy.ndimage.mean, and one
cv2.minMaxLoc pass over both frames, which is the least that looking at every pixel costs.

    python benchmarks/bench_imaging.py [--repetitions 25]
"""
# ruff: noqa: E402 - the number of threads is set before the libraries are loaded, which read it then

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import scipy
import sep
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "imaging"))

from frames import OFFSET_ADU, SIGMA_PX, exposed, gaussian_light
from imaging_instruments import hexagons, instrument

from namod_ctl.core.records import Record
from namod_ctl.imaging.facets import FacetPhotometer, pixels_of_polygon
from namod_ctl.imaging.measure import measure_record
from namod_ctl.imaging.star import Star, star_finder

Frame = NDArray[np.uint8]
STAR_SHAPE, REFLECTOR_SHAPE = (1920, 2560), (768, 1024)
N_ACCURACY, ACCURACY_SHAPE, PEAKS_ADU = 400, (400, 480), (20.0, 230.0)


def star_frames(n: int, rng: np.random.Generator) -> list[tuple[Frame, NDArray[np.float64]]]:
    """Smaller frames with one star each at a random place and of random brightness, and the true places."""
    frames = []
    for _ in range(n):
        true = rng.uniform(100.0, np.array(ACCURACY_SHAPE[::-1]) - 100.0)
        light = rng.uniform(*PEAKS_ADU) * gaussian_light(ACCURACY_SHAPE, *true, SIGMA_PX)
        frames.append((exposed(light, rng).astype(np.uint8), true))
    return frames


def reflector_frame(rng: np.random.Generator) -> Frame:
    """Thirty facets between dark and bright, in slightly different colours."""
    light = np.full((*REFLECTOR_SHAPE, 3), 4.0)
    for polygon in hexagons().values():
        pixels = pixels_of_polygon(polygon, REFLECTOR_SHAPE[1], REFLECTOR_SHAPE[0], "facet")
        light.reshape(-1, 3)[pixels] += rng.uniform(0.0, 200.0) * np.array([0.8, 1.0, 0.9])
    return np.asarray(
        np.stack([exposed(light[..., i], rng, offset_adu=OFFSET_ADU) for i in range(3)], axis=2), np.uint8
    )


def peer_centre(frame: Frame) -> NDArray[np.float64]:
    """sep: background, extraction, and the windowed position with the window its manual recommends."""
    data = frame.astype(np.float32)
    background = sep.Background(data)
    background.subfrom(data)
    found = sep.extract(data, 5.0, err=background.globalrms)
    star = found[int(np.argmax(found["flux"]))]
    radius, _ = sep.flux_radius(data, [star["x"]], [star["y"]], [6.0 * star["a"]], 0.5)
    x, y, _ = sep.winpos(data, [star["x"]], [star["y"]], 2.0 / 2.3548 * radius)
    return np.array([x[0], y[0]])


def peer_labels() -> NDArray[np.int32]:
    """The facets' polygons as the image of labels that scipy.ndimage wants, made once."""
    labels = np.zeros(REFLECTOR_SHAPE, np.int32)
    for number, polygon in hexagons().items():
        labels.flat[pixels_of_polygon(polygon, REFLECTOR_SHAPE[1], REFLECTOR_SHAPE[0], "facet")] = number
    return labels


def medians_s(jobs: dict[str, Callable[[], object]], repetitions: int) -> dict[str, NDArray[np.float64]]:
    """Times of every job, one after the other in every repetition, so that all see the same machine."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(repetitions):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in times.items()}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=25)
    repetitions = parser.parse_args().repetitions
    cv2.setNumThreads(1)
    rng = np.random.default_rng(2014)
    telescope = instrument()
    photometer = FacetPhotometer(telescope.facet_polygons_px, telescope.reflector.ids, *REFLECTOR_SHAPE[::-1])
    reflector = reflector_frame(rng)
    labels, numbers = peer_labels(), list(hexagons())
    star = exposed(200.0 * gaussian_light(STAR_SHAPE, 1200.3, 800.7, SIGMA_PX), rng).astype(np.uint8)

    finder = star_finder(telescope.star_camera, telescope.star_size_rad, star.dtype)

    def ours() -> Record:
        return measure_record(star, reflector, 0.1, 0.5, telescope, photometer, 0, "")

    def peer_facets() -> None:
        # Its one image of labels wants one image of values, and gets it in the cheapest way; it knows no law.
        ndimage.mean(cv2.cvtColor(reflector, cv2.COLOR_BGR2GRAY), labels, numbers)

    def peer() -> None:
        peer_centre(star)
        peer_facets()

    def floor() -> None:
        cv2.minMaxLoc(star)
        cv2.minMaxLoc(reflector.reshape(REFLECTOR_SHAPE[0], -1))

    jobs: dict[str, Callable[[], object]] = {
        "namod-ctl: measure_record": ours,
        "    of that: star": lambda: finder.find(star),
        "    of that: facets": lambda: photometer.measure(reflector, telescope.reflector_camera, 0.5),
        "sep + scipy.ndimage.mean": peer,
        "    of that: sep": lambda: peer_centre(star),
        "floor: cv2.minMaxLoc, both frames": floor,
    }
    times = medians_s(jobs, repetitions)
    own, least = times["namod-ctl: measure_record"], times["floor: cv2.minMaxLoc, both frames"]
    console = Console(width=110)
    versions = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}, sep {sep.__version__}"
    table = Table(
        title=f"One record, one thread, medians of {repetitions} interleaved repetitions",
        caption=f"Python {platform.python_version()}, {versions}",
    )
    for heading in ("", "time / ms", "quartiles / ms", "times ours", "times the floor"):
        table.add_column(heading, justify="left" if heading == "" else "right")
    for name, values in times.items():
        low, middle, high = np.percentile(values, [25, 50, 75]) * 1000.0
        table.add_row(
            name,
            f"{middle:.2f}",
            f"{low:.2f} .. {high:.2f}",
            f"{np.median(values / own):.2f}",
            f"{np.median(values / least):.1f}",
        )
    console.print(table)

    frames = star_frames(N_ACCURACY, rng)
    stars = [finder.find(frame) for frame, _ in frames]
    errors = {
        "namod-ctl": np.array(
            [(s.x_px, s.y_px) - t for s, (_, t) in zip(stars, frames, strict=True) if isinstance(s, Star)]
        ),
        "sep winpos": np.array([peer_centre(frame) - true for frame, true in frames]),
    }
    accuracy = Table(
        title=f"Centres of {N_ACCURACY} stars, peaks {PEAKS_ADU[0]:.0f} to {PEAKS_ADU[1]:.0f} of 255, at random places"
    )
    for heading in ("", "stars", "rms error / px", "median error / px", "largest / px"):
        accuracy.add_column(heading, justify="left" if heading == "" else "right")
    for name, error in errors.items():
        distance = np.hypot(*error.T)
        rms = np.sqrt(np.mean(error**2))
        accuracy.add_row(name, str(len(error)), f"{rms:.5f}", f"{np.median(distance):.5f}", f"{distance.max():.4f}")
    console.print(accuracy)


if __name__ == "__main__":
    main()
