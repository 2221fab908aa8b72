"""Words of ROS's launchers on the command lines of nodes: ``run``, ``sim`` and ``record``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import typer

from vlatool.files.printable import printable

if TYPE_CHECKING:
    from vlatool.buses import RosWords

NODES = ("run", "sim", "record")
"""Commands that are nodes."""
KEY = "vlatool.ros"


def take_ros_words(context: Any, arguments: list[str], root_options: tuple[str, ...]) -> list[str]:
    """Return a command line without what a launcher of ROS added to it, which the context of a node's command keeps.

    Args:
        context: Context of the command line.
        arguments: Its words.
        root_options: Options with a value that may stand before the command.

    Raises:
        UsageError: as ``split_ros_words`` does.
    """
    if context.resilient_parsing or _command(arguments, root_options) not in NODES:
        return arguments
    if not any(":=" in word or word == "--ros-args" for word in arguments):
        return arguments
    from vlatool.buses import split_ros_words

    others, context.meta[KEY] = split_ros_words(arguments)
    return others


def _command(arguments: list[str], root_options: tuple[str, ...]) -> str:
    words = iter(arguments)
    for word in words:
        if word in root_options:
            next(words, None)
        elif not word.startswith("-"):
            return word
    return ""


def ros_words(context: typer.Context) -> RosWords | None:
    """Return what a launcher of ROS says of the node; None without one."""
    words: RosWords | None = context.meta.get(KEY)
    return words


def parameters(words: RosWords | None, bus: str, node: str) -> dict[str, Any]:
    """Return the parameters of a node that a launcher of ROS started, and say which there are.

    Args:
        words: What the launcher says; None without one.
        bus: Bus, as ``open_bus`` takes it; where it is empty, none is asked.
        node: Name of the node without a launcher.

    Raises:
        UsageError, BusError, DataError: as ``launch_parameters`` does.
    """
    if words is None:
        return {}
    from vlatool.buses import launch_parameters

    values = launch_parameters(bus, node, words)
    if values:
        text = ", ".join(f"{name} = {value}" for name, value in values.items())
        typer.echo(printable(f"parameters of the node: {text}"), err=True)
    return values


def unused_remappings(words: RosWords | None, node: str, topics: set[str]) -> Iterator[str]:
    """Yield a sentence on each remapping of a topic that a node does not have.

    Args:
        words: What the launcher says; None without one.
        node: Full name of the node.
        topics: Topics of the node, as they are on the bus.
    """
    for left, right in [] if words is None else words.topics():
        namespace = node.strip("/").rpartition("/")[0]
        full = {"/": right, "~": f"/{node.strip('/')}/{right.lstrip('~/')}"}.get(right[0], f"/{namespace}/{right}")
        if full.replace("//", "/") not in topics:
            yield f"the remapping {left}:={right} changes no topic of this node"
