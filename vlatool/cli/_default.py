"""A group of commands whose first word may be something else: then its default command is meant."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from vlatool.cli import _complete


def group_with(default: str) -> type[TyperGroup]:
    """Return a class of groups that insert a command where the first word names none."""

    class Group(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            if args and args[0] not in ("--help", *self.list_commands(ctx)):
                args = [default, *args]
            return super().parse_args(ctx, args)

        def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
            return [*super().shell_complete(ctx, incomplete), *_complete.items(_complete.sources(incomplete))]

    return Group
