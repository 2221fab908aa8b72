"""Telemetry of a board during a run: power, energy, temperatures, clocks and throttling.

One file for each source. ``open_all`` gives the readers of this machine and what it lacks; ``Recorder`` samples them.
"""

from vlatool.telemetry._open import open_all
from vlatool.telemetry._reading import DEGREE, THROTTLE, Absent, Reader, Reading, Run
from vlatool.telemetry._summary import Change, Energy, Gauge, Series, Summary, collect, summarise
from vlatool.telemetry._total import Total, totals
from vlatool.telemetry.recorder import Recorder

__all__ = [
    "DEGREE",
    "THROTTLE",
    "Absent",
    "Change",
    "Energy",
    "Gauge",
    "Reader",
    "Reading",
    "Recorder",
    "Run",
    "Series",
    "Summary",
    "Total",
    "collect",
    "open_all",
    "summarise",
    "totals",
]
