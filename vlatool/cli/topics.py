"""``vlatool topics``."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BusName
from vlatool.files.printable import printable

NODE = f"vlatool_topics_{os.getpid()}"
"""In ROS 1 a second node of the same name ends the first one."""


def topics(
    bus: BusName,
    seconds: Annotated[float, typer.Option(min=0, max=3600, help="how long to listen")] = 2.0,
    as_json: AsJson = False,
) -> None:
    """List the topics on a bus: types, rates, ages, publishers and subscribers, and what is wrong with them."""
    from vlatool.buses import open_bus
    from vlatool.nodes.topic_survey import lines, survey

    opened = open_bus(bus, NODE)
    try:
        found = survey(opened, NODE, seconds)
    finally:
        opened.close()
    answer(as_json, {"bus": bus, "topics": [report.to_dict() for report in found]}, map(printable, lines(found)))
