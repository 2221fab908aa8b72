"""Processor, processes and version of vlatool on this machine."""
