"""Buses: how a controller's messages reach a robot; one file each, whose library is imported when it is opened."""

from vlatool.buses._interface import (
    GOAL_ABORTED,
    GOAL_CANCELED,
    GOAL_SUCCEEDED,
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
    "GOAL_ABORTED",
    "GOAL_CANCELED",
    "GOAL_SUCCEEDED",
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
