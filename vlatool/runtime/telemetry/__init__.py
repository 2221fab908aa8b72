"""Telemetry of the stack: what each control step was like, written off its path."""

from vlatool.runtime.telemetry.record import PARTS, Delivery, Sink, TickRecord
from vlatool.runtime.telemetry.writer import Telemetry

__all__ = ["PARTS", "Delivery", "Sink", "Telemetry", "TickRecord"]
