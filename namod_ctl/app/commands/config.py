"""`namod-ctl config`: check an instrument's config and say what was understood."""

from __future__ import annotations

import re
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from namod_ctl.app.build.actuators import check_ports
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import builtin_names, find_config, load_config
from namod_ctl.app.config.summary import Summary, summarize, warnings_of
from namod_ctl.core.errors import ConfigError

app = typer.Typer(
    add_completion=False,
    rich_markup_mode="markdown",
    help="Check the config of an instrument, list those that come with the program.",
    epilog="Example: namod-ctl config check fact",
)


@app.command("check")
def check(
    config: Annotated[str, typer.Argument(metavar="FILE", help="A TOML file, or a built-in name such as fact.")],
    ports: Annotated[
        bool, typer.Option("--ports", help="Also open the actuators' lines for a moment; nothing is sent.")
    ] = False,
) -> None:
    """Validate a config and print what it says, in plain words.

    Example: namod-ctl config check fact_actuated
    """
    try:
        loaded = load_config(config)
    except ConfigError as error:
        raise _listed(config, str(error).splitlines()) from None
    if ports:
        check_ports(loaded)
    instrument = build_instrument(loaded)
    console = Console()
    for summary in summarize(loaded, instrument):
        console.print(_table(summary))
    for warning in warnings_of(loaded, instrument):
        console.print(Text(f"warning: {warning}", style="yellow"))
    console.print(Text(f"{config}: valid", style="green"))


def _listed(config: str, problems: list[str]) -> ConfigError:
    """The problems below each other, none with the config's own name before it, which is said once."""
    if len(problems) == 1:
        return ConfigError(problems[0])
    path = find_config(config)
    lines = [re.sub(rf"^{re.escape(str(path))}( \(extends [^)]*\))?: ", "", problem) for problem in problems]
    return ConfigError("\n  ".join([f"{config}: these are its problems:", *lines]))


@app.command("list")
def list_builtin() -> None:
    """List the configs that come with the program.

    Example: namod-ctl config list
    """
    table = Table("name", "telescope", "facets", "focal length", box=None, pad_edge=False)
    for name in builtin_names():
        loaded = load_config(name)
        focal_length_m = loaded.telescope.focal_length_m
        table.add_row(name, loaded.telescope.name, str(len(loaded.facets)), f"{focal_length_m:g} m")
    Console().print(table)


def _table(summary: Summary) -> Table:
    table = Table(title=summary.title, title_justify="left", show_header=False, box=None, pad_edge=False)
    table.add_column(width=18, style="bold")
    table.add_column(overflow="fold")
    for label, value in summary.rows:
        table.add_row(label, value)
    return table
