"""``vlatool sim``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer
from typer.core import TyperGroup

from vlatool import registry
from vlatool.cli._controllers import flags_of, summary_of, values_of
from vlatool.cli._document import answer
from vlatool.cli._launch_words import parameters, ros_words
from vlatool.cli._options import BusName
from vlatool.cli._signals import stopped_by_signals
from vlatool.cli._stages import build_command, failing_command
from vlatool.errors import PluginError, UsageError
from vlatool.files.printable import printable

if TYPE_CHECKING:
    from vlatool.buses import RosWords


class WorldGroup(TyperGroup):
    """A group whose commands are the simulated robots."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the simulated robots."""
        return [name.replace("_", "-") for name in registry.names("worlds")]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the named robot; for an unknown one, suggest the nearest."""
        if args and args[0].replace("_", "-") not in self.list_commands(ctx) and not ctx.resilient_parsing:
            raise UsageError.unknown(f"Unknown simulated robot '{args[0]}'", args[0], self.list_commands(ctx))
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Build the command of one robot."""
        if cmd_name.replace("_", "-") not in self.list_commands(ctx):
            return None
        try:
            world = registry.load("worlds", cmd_name)
        except PluginError as error:
            return failing_command(cmd_name, error)
        return build_command(world_function(cmd_name, world), cmd_name, summary_of(world))


app = typer.Typer(cls=WorldGroup, no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Simulate a robot on a bus, in real time, until Ctrl-C."""


COMMON: dict[str, tuple[Any, Any]] = {
    "bus": (BusName, ...),
    "seconds": (Annotated[Optional[float], typer.Option("--seconds", min=0, help="end after so many seconds; at "  # noqa: UP045
                                                        "Ctrl-C or SIGTERM when not given")], None),
    "seed": (Annotated[int, typer.Option("--seed", min=0, help="seed of the scene and of all noise")], 0),
    "settings": (Annotated[Optional[Path], typer.Option("--settings", help="JSON file of knobs; flags count before "  # noqa: UP045
                                                        "it")], None),
    "node": (Annotated[str, typer.Option("--node", help="name on the bus; vlatool_ROBOT when not given")], ""),
    "as_json": (Annotated[bool, typer.Option("--json", help="print JSON on stdout")], False),
}  # fmt: skip
"""Flags of every simulated robot: name -> annotation and default."""


def world_function(name: str, world: type) -> Callable[..., None]:
    """Return a function whose signature has the knobs of a simulated robot and the common flags."""
    flags = flags_of(world, COMMON)

    def command(**arguments: Any) -> None:
        context: typer.Context = arguments.pop("context")
        knobs = values_of(world, context, {key: arguments.pop(key) for key in flags})
        _simulate(name, world, knobs, ros_words(context), **arguments)

    typed = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    shared = [inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
              for key, (annotation, default) in COMMON.items()]  # fmt: skip
    parameters = [typed, *flags.values(), *shared]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def _simulate(
    name: str, world: type, knobs: dict[str, Any], words: RosWords | None, *, bus: str, seconds: float | None,
    seed: int, settings: Path | None, node: str, as_json: bool,
) -> None:  # fmt: skip
    """Simulate a robot on a bus."""
    from vlatool.buses import name_on, open_bus
    from vlatool.nodes.fault_watch import fault_text, to_plain_faults
    from vlatool.nodes.settings import build, read_settings
    from vlatool.nodes.world_node import WorldNode

    node = node or f"vlatool_{name.replace('-', '_')}"
    chosen = {
        **({} if settings is None else read_settings(settings)), **parameters(words, bus, node), **knobs,
    }  # fmt: skip
    robot = build(world, chosen, f"vlatool sim {name}")
    opened = open_bus(bus, node, words)
    try:
        simulated = WorldNode(robot, opened, seed)
        sensors, commands = (", ".join(name_on(opened, channel.topic) for channel in each)
                             for each in (robot.sensors, robot.commands))  # fmt: skip
        typer.echo(printable(f"{name} reports {sensors} and obeys {commands}"), err=True)
        try:
            with stopped_by_signals(simulated.stop):
                simulated.run(seconds)
        finally:
            simulated.summary.seconds = robot.time_s
            faults = opened.faults()
            found = {"robot": name, **vars(simulated.summary), "truth": dict(robot.truth()),
                     "faults": to_plain_faults(faults)}  # fmt: skip
    finally:
        opened.close()
    lines = [f"{found['seconds']:.1f} s simulated, {found['reports']} reports, {found['commands']} commands, "
             f"{found['behind_s']:.1f} s behind real time"]  # fmt: skip
    answer(as_json, found, lines + [printable(f"  on the bus: {fault_text(fault)}") for fault in faults])
