"""What a factory gave, as torch modules in evaluation mode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vlatool.errors import SourceError, nearest, require


def modules_of(made: Any, wanted: Iterable[str]) -> dict[str, Any]:
    """Return the modules that a program runs: graph name -> torch module in evaluation mode.

    Args:
        made: A module, a program of ``torch.export``, or a mapping of graph names to them.
        wanted: Names of the program's graphs.

    Raises:
        SourceError: when one is missing or is something else.
    """
    torch = require("torch", "build")
    given = made if isinstance(made, Mapping) else {"main": made}
    found = {}
    for name in dict.fromkeys(wanted):
        if name not in given:
            raise SourceError(f"The program runs '{name}', which the factory does not give; {nearest(name, given)}.")
        module = given[name]
        if isinstance(module, torch.export.ExportedProgram):
            module = module.module()
        if not isinstance(module, torch.nn.Module):
            raise SourceError(f"The factory gave a {type(module).__name__} for '{name}'; wanted a torch module.")
        found[name] = _evaluating(module)
    return found


def _evaluating(module: Any) -> Any:
    """Put a module into evaluation mode; a part that torch.export made has the mode in which it was exported."""
    try:
        return module.eval()
    except NotImplementedError:
        for part in module.modules():
            part.training = False
        return module
