"""What the crew sees of a campaign in a terminal: one line per step, a live panel while records come in."""

from __future__ import annotations

import math
import select
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Literal, Self

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from namod_ctl.app.views.number_ranges import counted, numbers_of_words
from namod_ctl.app.views.recording_view import TerminalView
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import m_to_mm, rad2_to_arcmin2
from namod_ctl.cycle.campaign_parts import View
from namod_ctl.cycle.machine import STATES
from namod_ctl.cycle.plan import Plan
from namod_ctl.cycle.progress import Progress
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign_rows import Cycle

WAIT_S = 0.1
MAX_REFUSED_SHOWN = 5


class AlignView(View):
    """Shows a campaign on a console; a context manager."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: TerminalView | None = None
        self._state = ""
        self._is_asked = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_live()

    def state(self, state: str, reason: str) -> None:
        """A line for every new state."""
        if state == self._state and not reason:
            return
        self._end_live()
        self._state = state
        meaning = reason or STATES[state]
        self._console.print(f"[bold]{state.replace('_', ' '):>17}[/bold]  {escape(meaning)}", soft_wrap=True)

    def recording(self, cycle: int, progress: Progress) -> None:
        """The recorder's own view."""
        if self._live is None:
            self._live = TerminalView(self._console, f"cycle {cycle}", has_estimate=False).__enter__()
        self._live.show(progress)

    def measured(self, cycle: Cycle, result: Reconstruction) -> None:
        """The area and what follows from it."""
        self._line(f"cycle {cycle.number}: {cycle.decision}")

    def plan(self, plan: Plan) -> None:
        """How many legs move how far, and what is refused."""
        travels_mm = [abs(m_to_mm(order.target_m - order.start_m)) for order in plan.orders]
        if travels_mm:
            self._line(
                f"{counted(len(plan.orders), 'leg')} of {counted(len(plan.turned), 'facet')}, up to "
                f"{max(travels_mm):.3f} mm; predicted {rad2_to_arcmin2(plan.forecast.a_sigma_rad2):.2f} arcmin2"
            )
        else:
            self._line(f"{counted(len(plan.turned), 'facet')} to turn by hand")
        for facet_id, why in list(plan.refused.items())[:MAX_REFUSED_SHOWN]:
            self._line(f"facet {facet_id} stays as it is: {why}")
        if len(plan.refused) > MAX_REFUSED_SHOWN:
            self._line(f"so do {len(plan.refused) - MAX_REFUSED_SHOWN} more; namod-ctl status lists them")

    def told(self, text: str) -> None:
        """A sentence of the campaign."""
        self._line(text)

    def answer(self) -> bool | None:
        """What the person at this terminal types: yes or no, and Enter."""
        text = self._typed("carry it out? [y/n] (or `namod-ctl approve` elsewhere) ")
        return None if text is None else text.lower() in ("y", "yes")

    def turned(self) -> Sequence[int] | Literal["all"]:
        """What the person at this terminal types: ids of facets such as 13,31,2-7, or all, and Enter."""
        text = self._typed("which facets are turned? [13,31,2-7 or all] (or `namod-ctl done` elsewhere) ")
        if not text:
            return ()
        if text.lower() == "all":
            return "all"
        try:
            return numbers_of_words(text)
        except ConfigError as problem:
            self._line(f"{problem}; or all")
        return ()

    def wait(self) -> None:
        """Until somebody types, or a moment is over in which requests of other terminals may have come."""
        select.select([sys.stdin] if sys.stdin.isatty() else [], [], [], WAIT_S)

    def _typed(self, question: str) -> str | None:
        """The line that was typed since the question was put, which it is once; None as long as there is none."""
        if not sys.stdin.isatty():
            return None
        if not self._is_asked:
            self._is_asked = True
            self._console.print(question, end="", markup=False)
        if not select.select([sys.stdin], [], [], 0.0)[0]:
            return None
        self._is_asked = False
        return sys.stdin.readline().strip()

    def _line(self, text: str) -> None:
        self._end_live()
        self._console.print(f"{'':17}  {text}", soft_wrap=True, markup=False)

    def _end_live(self) -> None:
        if self._live is not None:
            live, self._live = self._live, None
            live.__exit__(None, None, None)


def cycle_table(cycles: list[Cycle]) -> Table:
    """One row per cycle."""
    table = Table()
    for name in ("cycle", "records", "A_sigma / arcmin2", "predicted", "decision"):
        table.add_column(name, justify="left" if name == "decision" else "right")
    for cycle in cycles:
        now, doubt, predicted = (
            f"{rad2_to_arcmin2(area):.2f}" if math.isfinite(area) else ""
            for area in (cycle.a_sigma_now_rad2, cycle.a_sigma_uncertainty_rad2, cycle.a_sigma_predicted_rad2)
        )
        table.add_row(
            str(cycle.number),
            str(cycle.n_records),
            f"{now} +- {doubt}" if now and doubt else now or "-",
            predicted or "-",
            cycle.decision.split(":")[0],
        )
    return table
