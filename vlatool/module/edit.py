"""A change of a module's structure."""

from __future__ import annotations

from dataclasses import dataclass, replace

REMAKE = "make the bundle again from its policy: vlatool prune, or vlatool rebuild; edits are not written by hand"
"""What to do about an edit that does not fit."""


@dataclass(frozen=True)
class Edit:
    """Channels or blocks of one module that are kept.

    Args:
        graph: name of the graph whose module it is in.
        module: its name, as ``named_modules`` gives it.
        axis: ``outputs`` (rows of the weight, the bias), ``inputs`` (columns of the weight) or ``blocks`` (the modules
            of an ``nn.ModuleList`` or ``nn.Sequential``); ``units A.P`` (then ``module`` names a weight) is factor P of
            its axis A, as ``vlatool.module.axes`` finds it, with all that goes along; ``units A.P.S.Q`` is factor Q of
            segment S, where that factor is a concatenation. What loses units is traced: ``units@2 A.P`` are factors of
            the trace of what those of the first trace left, and so on.
        keep: indices of what stays, in the order in which it stays.
    """

    graph: str
    module: str
    axis: str
    keep: tuple[int, ...]

    @property
    def trace(self) -> int:
        """Return the number of the trace whose units it names, from 1 on; 0 for what needs no trace."""
        kind, _, _ = self.axis.partition(" ")
        return int(kind.removeprefix("units").removeprefix("@") or 1) if kind.startswith("units") else 0

    @property
    def path(self) -> tuple[int, ...]:
        """Return the numbers of axis and factor of the units that it names."""
        return tuple(int(number) for number in self.axis.partition(" ")[2].split("."))

    def after(self, traces: int) -> Edit:
        """Return the edit of what so many traces left."""
        if not self.trace or not traces:
            return self
        return replace(self, axis=f"units@{self.trace + traces} {'.'.join(map(str, self.path))}")
