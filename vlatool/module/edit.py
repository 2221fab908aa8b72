"""One change of a module's structure."""

from __future__ import annotations

from dataclasses import dataclass

AGAIN = "make the bundle again from its policy: vlatool prune, or vlatool rebuild; edits are not written by hand"
"""What to do about an edit that does not fit."""


@dataclass(frozen=True)
class Edit:
    """Channels or blocks of one module that are kept.

    Args:
        graph: Name of the graph whose module it is in.
        module: Its name, as ``named_modules`` gives it.
        axis: ``outputs`` (rows of the weight, the bias), ``inputs`` (columns of the weight) or ``blocks`` (the modules
            of an ``nn.ModuleList`` or ``nn.Sequential``); ``units A.P`` (then ``module`` names a weight) is factor P of
            its axis A, as ``vlatool.module.axes`` finds it, with all that goes along; ``units A.P.S.Q`` is factor Q of
            segment S, where that factor is a concatenation.
        keep: Indices of what stays, in the order in which it stays.
    """

    graph: str
    module: str
    axis: str
    keep: tuple[int, ...]
