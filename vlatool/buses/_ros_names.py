"""Names of nodes, topics and services, as ROS resolves them."""

from __future__ import annotations

import re

from vlatool.errors import UsageError

NODE = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
NAME = re.compile(r"(?:~/?|/)?[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*", re.ASCII)
"""What ROS 1 and ROS 2 both take: parts of letters, digits and ``_``, with a slash between them."""


def check_node(node: str) -> str:
    """Return the name of a node.

    Raises:
        UsageError: for one that ROS does not take.
    """
    if not NODE.fullmatch(node):
        raise UsageError(
            f"'{node}' cannot be the name of a node; allowed: letters, digits and '_', a letter first.",
            f"write '{_corrected(node) or 'vlatool_node'}'",
        )
    return node


def resolve(name: str, node: str) -> str:
    """Return the full name of a topic or service: ``cmd_vel`` -> ``/cmd_vel``, ``~status`` -> ``/NODE/status``.

    Raises:
        UsageError: for one that ROS does not take.
    """
    if not NAME.fullmatch(name):
        raise UsageError(
            f"'{name}' cannot be the name of a topic or service; allowed: letters, digits, '_' and '/', such as "
            "/cmd_vel, each part with a letter first.",
            f"write '/{_corrected(name) or 'topic'}'",
        )
    if name.startswith("~"):
        return f"/{node}/{name.lstrip('~/')}"
    return name if name.startswith("/") else f"/{name}"


def _corrected(name: str) -> str:
    parts = (re.sub(r"^[^A-Za-z]+", "", re.sub(r"[^A-Za-z0-9_]", "_", part)) for part in name.split("/"))
    return "/".join(part for part in parts if part)
