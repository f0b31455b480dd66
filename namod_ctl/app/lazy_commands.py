"""Groups of commands whose modules are imported when they are called: none waits for the libraries of another."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any, ClassVar, Literal

import typer
from typer.core import TyperGroup

MARKUP: Literal["markdown"] = (
    "markdown"  # typer's default swallows what is written in brackets, such as [default: auto]
)


class LazyCommands(TyperGroup):
    """A group of the commands of `commands_of_group`, in its order: "module:name" by the command's name.

    What is named is a typer app, or one function.
    """

    commands_of_group: ClassVar[Mapping[str, str]]

    # typer brings its own copy of click or the real one, depending on its version: hence Any
    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands_of_group)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in self.commands_of_group:
            return None
        module, name = self.commands_of_group[cmd_name].split(":")
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
        known = self.commands_of_group
        if args and args[0] not in known and not args[0].startswith("-"):
            near = get_close_matches(args[0], known)
            whole = ctx.command_path
            hint = f"Did you mean {' or '.join(map(repr, near))}?" if near else f"{whole} --help lists all commands."
            ctx.fail(f"No such command {args[0]!r}. {hint}")
        return super().resolve_command(ctx, args)
