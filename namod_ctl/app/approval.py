"""The question before anything moves."""

from __future__ import annotations

import sys

import typer

from namod_ctl.core.errors import ConfigError


def ask_before_moving(question: str, *, is_yes: bool) -> None:
    """Nothing when the person says yes, or `is_yes` said so beforehand.

    Raises
    ------
    ConfigError
        There is nobody to be asked.
    typer.Abort
        The answer was no.
    """
    if is_yes:
        return
    try:
        typer.confirm(question, abort=True)
    except typer.Abort:
        if sys.stdin.isatty():
            raise
        typer.echo()
        raise ConfigError(
            "nothing was moved: nobody answered yes. Without a terminal, write the answer beforehand: --yes"
        ) from None
