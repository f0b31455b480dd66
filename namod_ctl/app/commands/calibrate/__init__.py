"""`namod-ctl calibrate`: what the method stands on is measured, checked and renewed."""

from __future__ import annotations

import typer

from namod_ctl.app.lazy_commands import MARKUP, LazyCommands

_ROOM = "namod_ctl.app.commands.calibrate"

_COMMANDS = {
    "show": f"{_ROOM}.show:show",
}


class _Commands(LazyCommands):
    commands_of_group = _COMMANDS


app = typer.Typer(
    cls=_Commands,
    help="Calibrate the cameras, and check calibrations: each becomes a file that the config names.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=MARKUP,
)


@app.callback()
def _root() -> None:
    pass
