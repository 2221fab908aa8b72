"""The machine that this runs on: its processor, processes and version of vlatool."""
