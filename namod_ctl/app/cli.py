"""The command line: one thin function per command, and the one place where errors become messages."""

from __future__ import annotations

import sys

import typer

from namod_ctl import __version__
from namod_ctl.app.commands import config, imports
from namod_ctl.app.commands.export import export
from namod_ctl.app.commands.instruct import instruct
from namod_ctl.app.commands.raytrace import raytrace
from namod_ctl.app.commands.reconstruct import reconstruct_run
from namod_ctl.core.errors import NamodError

app = typer.Typer(
    help="Align the segmented mirror of a Cherenkov telescope with two cameras, by the NAMOD method.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"namod-ctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    pass


app.command("raytrace")(raytrace)
app.command("reconstruct")(reconstruct_run)
app.command("instruct")(instruct)
app.command("export")(export)


app.add_typer(imports.app, name="import")
app.add_typer(config.app, name="config")


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
