"""Buses: how a controller's messages reach a robot; one file each, whose library is imported when it is opened."""

from vlatool.buses._interface import (
    ABORTED,
    CANCELED,
    SUCCEEDED,
    ActionBus,
    ActionType,
    Bus,
    ClientGoal,
    Fault,
    Goal,
    Outcome,
    QoS,
    Reception,
    TopicInfo,
    open_bus,
)

__all__ = [
    "ABORTED",
    "CANCELED",
    "SUCCEEDED",
    "ActionBus",
    "ActionType",
    "Bus",
    "ClientGoal",
    "Fault",
    "Goal",
    "Outcome",
    "QoS",
    "Reception",
    "TopicInfo",
    "open_bus",
]
