"""`namod-ctl calibrate show`: what calibration files say, for a person."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.config.calibration_schema import Calibration
from namod_ctl.app.config.calibrations import read_calibration
from namod_ctl.app.views.calibration_rows import values_in_words
from namod_ctl.core.clock import SystemClock


def show(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Calibration files.")],
) -> None:
    """Say what calibration files hold, of which camera they are, and until when they are valid.

    Example: namod-ctl calibrate show star_radiometric.json
    """
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for number, path in enumerate(files):
        if number:
            console.print()
        console.print(f"{path}:", style="bold")
        for name, words in _rows(read_calibration(path), SystemClock().now()):
            console.print(f"  {name:16s} {words}")


def _rows(calibration: Calibration, now: datetime) -> Iterator[tuple[str, str]]:
    serial = calibration.serial_number or "not known"
    yield "kind", f"{calibration.kind}, of the {calibration.camera.replace('_', ' ')}"
    yield "camera", f"{calibration.model}, serial number {serial}, {calibration.columns} x {calibration.rows} px"
    yield "made", f"{calibration.made_utc}, namod-ctl {calibration.program_version}"
    is_expired = now > datetime.fromisoformat(calibration.valid_until_utc)
    yield "valid until", calibration.valid_until_utc + (" EXPIRED" if is_expired else "")
    yield "made of", calibration.source
    yield from values_in_words(calibration)
    yield "verdict", calibration.verdict
    for remark in calibration.remarks:
        yield "", remark
