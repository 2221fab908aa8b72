"""Topics of a controller's inputs, outputs and services: its own names, or those that the user maps."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vlatool.controllers import RobotController
from vlatool.errors import UsageError

NAME = re.compile(r"/?[A-Za-z_~][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""What ROS takes for the name of a topic."""


@dataclass(frozen=True)
class TopicMap:
    """Name of an input, output or service of a controller -> name on the bus.

    Args:
        names: Every input, output and service.
    """

    names: Mapping[str, str]

    def __getitem__(self, name: str) -> str:
        return self.names[name]


def map_topics(controller: RobotController[Any], wanted: Mapping[str, str]) -> TopicMap:
    """Return the names on the bus of what a controller reads, writes and answers.

    Args:
        controller: The controller.
        wanted: Names that the user gives; the others are the controller's own.

    Raises:
        UsageError: for a name that the controller lacks, an impossible topic, or two outputs on one topic.
    """
    own = {entry.name: entry.topic for entry in controller.inputs}
    own.update({entry.name: entry.topic for entry in controller.outputs})
    own.update({entry.name: entry.service for entry in controller.services})
    for name, topic in wanted.items():
        if name not in own:
            raise UsageError.unknown(f"The controller has no input, output or service '{name}'", name, sorted(own))
        if not NAME.fullmatch(topic):
            raise UsageError(
                f"'{topic}' cannot be the name of a topic; allowed: letters, digits, '_' and '/', such as /cmd_vel.",
                f"pass --map {name}=/{re.sub('[^A-Za-z0-9_/]', '_', topic).strip('/') or name}",
            )
    names = own | {name: topic if topic.startswith(("/", "~")) else f"/{topic}" for name, topic in wanted.items()}
    written = [names[entry.name] for entry in controller.outputs]
    doubled = sorted({topic for topic in written if written.count(topic) > 1})
    if doubled:
        raise UsageError(
            f"Two outputs of the controller are mapped to {doubled[0]}.", "give each output a topic of its own"
        )
    return TopicMap(names)
