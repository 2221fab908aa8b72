"""Buses: how a controller's messages reach a robot; one file each, whose library is imported when it is opened."""

from vlatool.buses._interface import Bus, Fault, QoS, Reception, TopicInfo, open_bus

__all__ = ["Bus", "Fault", "QoS", "Reception", "TopicInfo", "open_bus"]
