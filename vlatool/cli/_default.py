"""A group of commands with a default: where the first word names no command, the default one runs."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from vlatool.cli import _complete


class DefaultGroup(TyperGroup):
    """A group that inserts its default command where the first word names none."""

    default = ""

    def names_command(self, ctx: Any, args: list[str]) -> bool:
        """Return whether the first word is a command, asks for help or is absent."""
        return not args or args[0].replace("_", "-") in ("--help", *self.list_commands(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command."""
        return super().parse_args(ctx, args if self.names_command(ctx, args) else [self.default, *args])

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return commands, and what the default command takes in their place."""
        return [*super().shell_complete(ctx, incomplete), *_complete.items(_complete.sources(incomplete))]


def group_with(default: str) -> type[TyperGroup]:
    """Return a class of groups with a default command."""
    return type("Group", (DefaultGroup,), {"default": default})
