"""Robot controllers: pure functions from what a robot reports to what it should do; one file each."""

from vlatool.controllers._interface import (
    Command,
    Input,
    Output,
    Reading,
    Request,
    RobotController,
    Service,
    Snapshot,
    with_policy,
)

__all__ = ["Command", "Input", "Output", "Reading", "Request", "RobotController", "Service", "Snapshot", "with_policy"]
