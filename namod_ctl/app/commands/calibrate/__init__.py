"""`namod-ctl calibrate`: what the method stands on is measured, checked and renewed."""

from __future__ import annotations

import typer

from namod_ctl.app.lazy_commands import MARKUP, LazyCommands

_ROOM = "namod_ctl.app.commands.calibrate"

_COMMANDS = {
    "dark": f"{_ROOM}.dark:dark",
    "radiometric": f"{_ROOM}.radiometric:radiometric",
    "normalization": f"{_ROOM}.normalization:normalization",
    "star-field": f"{_ROOM}.star_field:star_field",
    "trail": f"{_ROOM}.trail:trail",
    "chessboard": f"{_ROOM}.chessboard:chessboard",
    "axis": f"{_ROOM}.axis:axis",
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
