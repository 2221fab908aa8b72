"""Requests and responses of the services of the ROS package ``std_srvs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.schema import Message, boolean, string


@dataclass(frozen=True, eq=False)
class SetBoolRequest(Message, name="std_srvs/srv/SetBool_Request"):
    """What to set."""

    data: boolean = False


@dataclass(frozen=True, eq=False)
class SetBoolResponse(Message, name="std_srvs/srv/SetBool_Response"):
    """Whether it was set, and in words what happened."""

    success: boolean = False
    message: string = ""


@dataclass(frozen=True, eq=False)
class TriggerRequest(Message, name="std_srvs/srv/Trigger_Request"):
    """Asks to do what the service is for."""


@dataclass(frozen=True, eq=False)
class TriggerResponse(Message, name="std_srvs/srv/Trigger_Response"):
    """Whether it was done, and in words what happened."""

    success: boolean = False
    message: string = ""
