"""`namod-ctl devices`: what is plugged in, and what the config wants of it."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.views.camera_listing import list_all_cameras
from namod_ctl.app.views.device_tables import (
    Inventory,
    answering_servers,
    as_json,
    emulated_cameras,
    tables,
    wanted_devices,
)
from namod_ctl.devices.ports import list_serial_ports
from namod_ctl.devices.usb_tree import read_usb_tree

EXIT_MISSING = 1
"""A device that the config names was not found."""


def devices(
    config: Annotated[
        str | None, typer.Option("--config", help="Say which of its entries each device is, and which are missing.")
    ] = None,
    as_json_: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """List the cameras of all drivers, serial ports and the USB; exit code 1 when a device of the config is missing.

    Example: namod-ctl devices --config config/fact.toml
    """
    loaded = None if config is None else load_config(config)
    wanted = [] if loaded is None else wanted_devices(loaded)
    emulated = [] if loaded is None else emulated_cameras(loaded)
    found = (list_all_cameras(), list_serial_ports(), read_usb_tree())
    inventory = Inventory(*found, wanted, answering_servers(wanted), emulated)
    if as_json_:
        typer.echo(json.dumps(as_json(inventory), indent=1))
    else:
        _print(inventory)
    if inventory.missing:
        raise typer.Exit(EXIT_MISSING)


def _print(inventory: Inventory) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for table in tables(inventory):
        console.print(table)
    for listing in inventory.listings:
        if listing.remark:
            console.print(Text(f"{listing.driver}: {listing.remark}"))
        elif not listing.cameras:
            console.print(Text(f"{listing.driver}: no camera"))
    if not inventory.ports:
        console.print(Text("no serial ports"))
    for emulated in inventory.emulated:
        console.print(Text(emulated))
    for unlisted in inventory.unlisted:
        console.print(Text(unlisted))
    for warning in inventory.usb.warnings:
        console.print(Text(f"warning: {warning}", style="yellow"))
    for missing in inventory.missing:
        console.print(Text(missing, style="red"))
