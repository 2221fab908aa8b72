"""Simulated robots: the sensors and motors of a robot in MuJoCo, as messages; one file each."""

from vlatool.worlds._interface import Channel, World, open_world

__all__ = ["Channel", "World", "open_world"]
