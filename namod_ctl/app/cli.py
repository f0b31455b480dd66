"""The command line: where commands are found, and the one place where errors become messages."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Literal

import typer
from typer.core import TyperGroup

from namod_ctl import __version__
from namod_ctl.app.views.greeting import GREETING
from namod_ctl.core.errors import NamodError

MARKUP: Literal["markdown"] = (
    "markdown"  # typer's default swallows what is written in brackets, such as [default: auto]
)

# A command's module is imported when the command is called, so that none waits for the libraries of another.
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


class _Commands(TyperGroup):
    """The commands in the order in which a night needs them, imported on demand."""

    # typer brings its own copy of click or the real one, depending on its version: hence Any
    def list_commands(self, ctx: Any) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in _COMMANDS:
            return None
        module, name = _COMMANDS[cmd_name].split(":")
        target = getattr(import_module(module), name)
        if not isinstance(target, typer.Typer):
            function, target = (
                target,
                typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=MARKUP),
            )
            target.command(cmd_name)(function)
        command = typer.main.get_command(target)
        command.name = cmd_name
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            near = get_close_matches(args[0], _COMMANDS)
            hint = f"Did you mean {' or '.join(map(repr, near))}?" if near else "namod-ctl --help lists all commands."
            ctx.fail(f"No such command {args[0]!r}. {hint}")
        return super().resolve_command(ctx, args)


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
