"""The command line: where commands are found, and the one place where errors become messages."""

from __future__ import annotations

import sys

import typer

from namod_ctl import __version__
from namod_ctl.app.lazy_commands import MARKUP, LazyCommands
from namod_ctl.app.views.greeting import GREETING
from namod_ctl.core.errors import NamodError

# In the order in which a night needs them.
_COMMANDS = {
    "config": "namod_ctl.app.commands.config:app",
    "facets": "namod_ctl.app.commands.facets:app",
    "import": "namod_ctl.app.commands.imports:app",
    "devices": "namod_ctl.app.commands.devices:devices",
    "camera": "namod_ctl.app.commands.camera:app",
    "record": "namod_ctl.app.commands.record:record",
    "align": "namod_ctl.app.commands.align:align",
    "actuators": "namod_ctl.app.commands.actuators:app",
    "dashboard": "namod_ctl.app.commands.dashboard:dashboard",
    "reconstruct": "namod_ctl.app.commands.reconstruct:reconstruct_run",
    "instruct": "namod_ctl.app.commands.instruct:instruct",
    "report": "namod_ctl.app.commands.report:report",
    "compare": "namod_ctl.app.commands.compare:compare",
    "rereduce": "namod_ctl.app.commands.rereduce:rereduce",
    "calibrate": "namod_ctl.app.commands.calibrate:app",
    "psf": "namod_ctl.app.commands.psf:psf",
    "lut": "namod_ctl.app.commands.lut:app",
    "export": "namod_ctl.app.commands.export:export",
    "raytrace": "namod_ctl.app.commands.raytrace:raytrace",
    "status": "namod_ctl.app.commands.status:status",
    "stop": "namod_ctl.app.commands.control:stop",
    "pause": "namod_ctl.app.commands.control:pause",
    "resume": "namod_ctl.app.commands.control:resume",
    "approve": "namod_ctl.app.commands.control:approve",
    "refuse": "namod_ctl.app.commands.control:refuse",
    "release": "namod_ctl.app.commands.control:release",
    "done": "namod_ctl.app.commands.control:done",
}


class _Commands(LazyCommands):
    commands_of_group = _COMMANDS


app = typer.Typer(
    cls=_Commands,
    help="Align the segmented mirror of a Cherenkov telescope with two cameras, by the NAMOD method.",
    epilog="Let the Tab key complete commands and options: namod-ctl --install-completion",
    invoke_without_command=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=MARKUP,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"namod-ctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    ctx: typer.Context,
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    if ctx.invoked_subcommand is None:
        typer.echo(GREETING if sys.stdout.isatty() else ctx.get_help())


def main() -> None:
    """Run the command line; a `NamodError` or a full disk becomes a message and exit code 2."""
    try:
        app()
    except NamodError as error:
        typer.echo(f"namod-ctl: {error}", err=True)
        sys.exit(2)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        typer.echo(f"namod-ctl: {where}{error.strerror or error}", err=True)
        sys.exit(2)
