"""What the crew sees of a recording: a live view in a terminal, plain lines anywhere else."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Self

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from namod_ctl.app.views.number_ranges import counted
from namod_ctl.core.units import rad_to_arcmin, rad_to_deg
from namod_ctl.cycle.coverage import Coverage, cell_of
from namod_ctl.cycle.progress import Progress

REFRESH_S = 0.25
PLAIN_LINE_S = 10.0
_SHADES = "·░▒▓█"  # from no record to as many as the fullest cell
_STAR, _NEXT = "★", "✚"


class TerminalView:
    """Shows the progress of a recording on a console; a context manager that leaves the last state standing."""

    def __init__(self, console: Console, title: str, *, has_estimate: bool = True) -> None:
        self._console, self._title, self._has_estimate = console, title, has_estimate
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._shown_s = -math.inf
        self._is_warned = self._is_halted = False

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, progress: Progress, *, now: bool = False) -> None:
        """Show the progress, but not more often than people can read unless it must be `now`."""
        time_s = time.monotonic()
        is_news = (bool(progress.warning) and not self._is_warned) or progress.is_halted != self._is_halted
        interval_s = PLAIN_LINE_S if self._live is None else REFRESH_S
        if not (now or is_news) and time_s - self._shown_s < interval_s:
            return
        self._shown_s = time_s
        self._is_warned, self._is_halted = bool(progress.warning), progress.is_halted
        if self._live is not None:
            self._live.update(_panel(progress, self._title, has_estimate=self._has_estimate), refresh=True)
        else:
            self._console.print(
                plain_line(progress, has_estimate=self._has_estimate), soft_wrap=True, markup=False, highlight=False
            )


def plain_line(progress: Progress, *, has_estimate: bool = True) -> str:
    """The state of a recording in one line, and a second one when something is wrong."""
    wanted = "" if progress.n_wanted is None else f" of {progress.n_wanted}"
    parts = [
        f"{progress.n_accepted}{wanted} records",
        f"{sum(progress.rejected.values())} rejected",
        f"{counted(sum(progress.source.dropped.values()), 'frame')} retaken",
        f"{progress.rate_per_min:.0f} per minute",
        f"star {star_brightness(progress)}",
        f"coverage {progress.coverage.share:.0%}",
    ]
    if has_estimate:
        parts.append(_uncertainty(progress))
    line = ", ".join(parts)
    wrong = progress.warning or progress.trouble
    return f"{line}\n  {wrong}" if wrong else line


def coverage_lines(coverage: Coverage, theta_rad: np.ndarray, next_theta_rad: np.ndarray) -> list[str]:
    """The coverage as text, +x to the right and +y up, two characters per cell; the star and where it should go."""
    most = max(int(coverage.counts.max()), 1)
    inside = coverage.is_inside
    star, goal = cell_of(coverage, theta_rad), cell_of(coverage, next_theta_rad)
    lines = []
    for row in reversed(range(len(coverage.counts))):
        line = ""
        for column, count in enumerate(coverage.counts[row]):
            shade = _SHADES[math.ceil(int(count) / most * (len(_SHADES) - 1))]
            if (row, column) == star:
                line += _STAR + shade
            elif (row, column) == goal:
                line += _NEXT + shade
            else:
                line += 2 * shade if inside[row, column] or count else "  "
        lines.append(line)
    return lines


def steering(progress: Progress) -> str:
    """In which direction the star should move, for whoever drives the telescope."""
    if not np.isfinite(progress.theta_rad).all():
        return "no star at the moment"
    x_deg, y_deg = rad_to_deg(progress.next_theta_rad - progress.theta_rad)
    right = "right" if x_deg >= 0.0 else "left"
    up = "up" if y_deg >= 0.0 else "down"
    return f"bring the star {abs(x_deg):.2f} deg {right}, {abs(y_deg):.2f} deg {up}"


def star_brightness(progress: Progress) -> str:
    """The star's magnitude; without a zero point in the config, how much fainter it is than at best."""
    if not math.isfinite(progress.star_magnitude):
        return "not seen"
    if not progress.is_magnitude_relative:
        return f"{progress.star_magnitude:.2f} mag"
    return f"{progress.star_magnitude:+.2f} mag relative to the brightest of this run"


def _panel(progress: Progress, title: str, *, has_estimate: bool) -> RenderableType:
    numbers = Table.grid(padding=(0, 2))
    wanted = "" if progress.n_wanted is None else f" of {progress.n_wanted}"
    numbers.add_row("records", f"{progress.n_accepted}{wanted}")
    if has_estimate:
        numbers.add_row("worst facet", _uncertainty(progress))
    numbers.add_row("time", f"{progress.elapsed_s / 60.0:.1f} min, {progress.rate_per_min:.0f} records per minute")
    numbers.add_row(
        "exposures", f"star {_exposure(progress.star_exposure_s)}, reflector {_exposure(progress.reflector_exposure_s)}"
    )
    numbers.add_row("star", star_brightness(progress))
    rejected = ", ".join(f"{n} {reason.value.replace('_', ' ')}" for reason, n in progress.rejected.items())
    numbers.add_row("rejected", rejected or "none")
    dropped = ", ".join(f"{n} {cause.value}" for cause, n in progress.source.dropped.items())
    numbers.add_row("retaken", dropped or "none")
    numbers.add_row("coverage", f"{progress.coverage.share:.0%} of the region")
    numbers.add_row("next", steering(progress))
    map_text = Text("\n".join(coverage_lines(progress.coverage, progress.theta_rad, progress.next_theta_rad)))
    both = Table.grid(padding=(0, 3))
    both.add_row(map_text, numbers)
    parts: list[RenderableType] = []
    if progress.n_wanted is not None:
        bar = Table.grid(expand=True)  # a bar by itself does not end its line
        bar.add_row(ProgressBar(total=progress.n_wanted, completed=min(progress.n_accepted, progress.n_wanted)))
        parts.append(bar)
    parts.append(both)
    if progress.warning:
        parts.append(Text(progress.warning, style="bold red"))
    elif progress.trouble:
        parts.append(Text(progress.trouble, style="yellow"))
    return Panel(Group(*parts), title=Text(title))


def _uncertainty(progress: Progress) -> str:
    estimate = progress.estimate
    if estimate is None:
        return "no estimate yet"
    unseen = estimate.unseen_facet_ids
    without = f"{counted(len(unseen), 'facet')} not seen; " if unseen else ""
    if not math.isfinite(estimate.worst_uncertainty_rad):
        return f"not known yet ({without}{estimate.n_records} records)"
    worst_arcmin = rad_to_arcmin(estimate.worst_uncertainty_rad)
    return f"+-{worst_arcmin:.2f} arcmin (facet {estimate.worst_facet_id}; {without}{estimate.n_records} records)"


def _exposure(exposure_s: float) -> str:
    return f"{exposure_s:.3g} s" if math.isfinite(exposure_s) else "-"
