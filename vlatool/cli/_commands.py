"""The commands: one file each, one for each kind of stage, those of other packages; imported when they are named."""

from __future__ import annotations

import importlib
from typing import Any

import typer
from typer.core import TyperGroup

from vlatool import registry
from vlatool.cli._flag_conflicts import refuse_conflicting_flags
from vlatool.cli._launch_words import take_ros_words
from vlatool.cli._stages import DEFAULTS, StageGroup, build_command, failing_command
from vlatool.errors import PluginError, UsageError, suggest
from vlatool.stage.build import stage_kinds

FIRST_COMMAND = "optimize"
"""What most people want comes first in the help."""
ROOT_OPTIONS = ("--trust", "--python", "--unnorm-key")
"""Options of every command, which stand before it."""
HIDDEN_KINDS = ("sources",)
"""Kinds of stages that are not commands: a source is an argument of every command."""


class Commands(TyperGroup):
    """The group of all commands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take out what a launcher of ROS added to the command line of a node."""
        return super().parse_args(ctx, take_ros_words(ctx, args, ROOT_OPTIONS))

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands: the one for everything, then the others by name."""
        kinds = [kind for kind in stage_kinds() if kind not in HIDDEN_KINDS and registry.names(kind)]
        commands = {name.replace("_", "-") for name in (*registry.names("commands"), *kinds)}
        return sorted(commands, key=lambda name: (name != FIRST_COMMAND, name))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the named command; for an unknown one, suggest the nearest."""
        if args and args[0] not in (known := self.list_commands(ctx)) and not ctx.resilient_parsing:
            raise UsageError(f"Unknown command '{args[0]}'; {suggest(args[0], known)}.", "vlatool --help")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Build the command of one file, or of one kind of stage."""
        if cmd_name not in self.list_commands(ctx):
            return None
        if cmd_name in stage_kinds():
            package = importlib.import_module(registry.package_of(cmd_name))
            text = (package.__doc__ or "").strip().splitlines()[0]
            group: Any = typer.main.get_group(typer.Typer(cls=StageGroup, help=text, rich_markup_mode=None))
            group.name, group.default = cmd_name, DEFAULTS[cmd_name]
            return group
        try:
            source = registry.module("commands", cmd_name)
        except PluginError as error:
            return failing_command(cmd_name, error)
        command = getattr(source, "app", None) or getattr(source, cmd_name.replace("-", "_"), None)
        if not isinstance(command, typer.Typer) and not callable(command):
            missing = f"neither a function of that name nor a Typer 'app' is in {source.__name__}"
            words = f"The package {registry.plugin_of(source.__name__)} adds the command '{cmd_name}', but {missing}."
            return failing_command(cmd_name, PluginError(words, "report it to its authors"))
        return _built(command, cmd_name)


def _built(source: Any, name: str) -> Any:
    """Return the click command of a Typer application or of a function."""
    if not isinstance(source, typer.Typer):
        return build_command(source, name)
    source._add_completion = False
    command = typer.main.get_command(source)
    command.name = name
    return refuse_conflicting_flags(command)
