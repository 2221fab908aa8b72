"""Power mode of a Jetson from ``nvpmodel -q``: a line with the name, then a line with the number.

Source: the power pages of the Jetson Linux developer guide, and recorded output of JetPack 5 and 6.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from vlatool.machine.host import ROOT
from vlatool.telemetry._reading import COUNT, Absent, CommandReader, Reading, Run, gauge, runner

COMMAND = ("nvpmodel", "-q")
MODE = re.compile(r"NV Power Mode:[ \t]*(\S[^\r\n]*?)[ \t]*\r?\n\s*(\d{1,6})\s*$", re.MULTILINE)


class NvpmodelReader(CommandReader):
    """The number of the power mode as ``nvpmodel.mode`` with its name as note; read at the start and at the end."""

    name = "nvpmodel"
    period_s = math.inf

    @classmethod
    def open(cls, root: Path = ROOT, run: Run | None = None) -> NvpmodelReader | Absent:
        """Ask for the mode; absent without an answer."""
        return cls(runner(root, run)).or_absent(
            "nvpmodel -q prints no mode: this is not a Jetson, or the command needs sudo here", other_board=True
        )

    def read(self) -> list[Reading]:
        """Return the number of the mode; its name is the note."""
        mode = parse(self._run(COMMAND) or "")
        return gauge("nvpmodel.mode", mode[1], COUNT, mode[0]) if mode else []


def parse(text: str) -> tuple[str, int] | None:
    r"""Return name and number of the mode; None when the text does not have both.

    Example:
        >>> parse("NV Power Mode: 25W\n1\n")
        ('25W', 1)
    """
    mode = MODE.search(text)
    return (mode[1], int(mode[2])) if mode else None
