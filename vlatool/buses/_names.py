"""Names of nodes, topics, services, types and domains, as ROS and its middlewares write them."""

from __future__ import annotations

import os
import re

from vlatool.errors import UsageError

NODE = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
NAME = re.compile(r"(?:~/?|/)?[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*", re.ASCII)
"""What ROS 1 and ROS 2 both take: parts of letters, digits and ``_``, with a slash between them."""


DDS_TYPE = re.compile(r"(\w+)::(msg|srv|action)::dds_::(\w+)_")
MAX_DOMAIN = 232
"""Largest domain whose ports are below 65536 (DDSI-RTPS 2.2, section 9.6.1.1)."""


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


def dds_type(name: str) -> str:
    """Return a type's name on the wire.

    Example:
        >>> dds_type("geometry_msgs/msg/Twist")
        'geometry_msgs::msg::dds_::Twist_'
    """
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(name: str) -> str:
    """Return the ROS 2 name of a type on the wire; the name itself when it is not that of a ROS 2 type.

    Example:
        >>> ros_type("std_srvs::srv::dds_::SetBool_Request_")
        'std_srvs/srv/SetBool_Request'
    """
    match = DDS_TYPE.fullmatch(name)
    return "/".join(match.groups()) if match else name


def domain_id(text: str = "") -> int:
    """Return the ROS domain: what is given, else ``ROS_DOMAIN_ID``, else 0.

    Raises:
        UsageError: for what is not a domain.
    """
    value = text or os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if value.isascii() and value.isdecimal() and int(value) <= MAX_DOMAIN:
        return int(value)
    source = "" if text else " of the environment variable ROS_DOMAIN_ID"
    raise UsageError(f"The domain '{value}'{source} is not a whole number from 0 to {MAX_DOMAIN}.", "correct it")


def _corrected(name: str) -> str:
    parts = (re.sub(r"^[^A-Za-z]+", "", re.sub(r"[^A-Za-z0-9_]", "_", part)) for part in name.split("/"))
    return "/".join(part for part in parts if part)
