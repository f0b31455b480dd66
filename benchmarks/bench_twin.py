"""Rendering of one record by the twin, in one thread: star frame and reflector frame, default settings.

    python benchmarks/bench_twin.py [--repetitions 40] [--config fact]

Beside it, in the same run: the limit of 80 ms, and one cv2.GaussianBlur (sigma = 3 pixel) over a star frame as a
yardstick of what one pass over 5 million pixels costs on this machine. A dish of 1000 facets shows time and memory.
"""
# ruff: noqa: E402 - the number of threads is set before the libraries are loaded, which read it then

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import platform
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, load_config
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin

LIMIT_S = 0.080
LIMIT_GIB = 1.5
STAR_S, REFLECTOR_S = 0.05, 0.25


THOUSAND_FACETS = """
[telescope]
name = "1000 facets"
focal_length_m = 28.0
[reflector.layout]
shape = "hexagon"
width_m = 0.64
spacing_m = 0.66
inner_radius_m = 0.5
outer_radius_m = 10.83
parabola_share = 1.0
"""


def thousand_facets() -> InstrumentConfig:
    """The LST-like config with a dish of close to 1000 facets."""
    text = (builtin_folder() / "lst_like.toml").read_text()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "thousand.toml"
        path.write_text(THOUSAND_FACETS + text[text.index("[mount]") :])
        return load_config(path)


def medians_s(work: Callable[[int], None], n: int) -> tuple[float, float]:
    """Median and largest time of `work`, after one warm-up."""
    work(0)
    times = []
    for i in range(1, n + 1):
        begun = time.perf_counter()
        work(i)
        times.append(time.perf_counter() - begun)
    return float(np.median(times)), max(times)


def record_of(twin: Twin, is_aligned: bool) -> Callable[[int], None]:
    """One record, the telescope a good way further each time; an aligned dish on the axis lights all its facets."""
    if is_aligned:
        twin.apply_correction(-twin.true_theta_rad / 2.0)

    def work(i: int) -> None:
        if not is_aligned:
            twin.update(31.0 * i)
        twin.star_camera.start(STAR_S)
        twin.reflector_camera.start(REFLECTOR_S)
        twin.star_camera.fetch(1.0)
        twin.reflector_camera.fetch(1.0)

    return work


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=40)
    parser.add_argument("--config", default="fact")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frame = np.zeros((1920, 2560), np.uint8)
    blur_s, _ = medians_s(lambda _: cv2.GaussianBlur(frame, (0, 0), 3.0) is None, arguments.repetitions)
    table = Table(title=f"One record rendered, {STAR_S} s and {REFLECTOR_S} s; {platform.machine()}, 1 thread")
    for heading in ("what", "median ms", "largest ms", "of the limit", "in blurs", "build s", "peak GiB"):
        table.add_column(heading, justify="left" if heading == "what" else "right")
    for name, config, is_aligned in (
        (arguments.config, load_config(arguments.config), False),
        (f"{arguments.config}, aligned, star on the axis", load_config(arguments.config), True),
        (f"{len(thousand_facets().facets)} facets", thousand_facets(), False),
        (f"{len(thousand_facets().facets)} facets, aligned, star on the axis", thousand_facets(), True),
    ):
        begun = time.perf_counter()
        twin = build_twin(config, TwinSettings(), 1)
        build_s = time.perf_counter() - begun
        median_s, largest_s = medians_s(record_of(twin, is_aligned), arguments.repetitions)
        peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        table.add_row(
            name,
            f"{1e3 * median_s:.1f}",
            f"{1e3 * largest_s:.1f}",
            f"{median_s / LIMIT_S:.0%}",
            f"{median_s / blur_s:.1f}",
            f"{build_s:.1f}",
            f"{peak_gib:.2f}",
        )
    table.add_row(
        "cv2.GaussianBlur of a star frame", f"{1e3 * blur_s:.1f}", "", f"{blur_s / LIMIT_S:.0%}", "1.0", "", ""
    )
    Console().print(table)
    Console().print(f"Limits: {1e3 * LIMIT_S:.0f} ms per record for FACT, {LIMIT_GIB} GiB for 1000 facets.")


if __name__ == "__main__":
    main()
