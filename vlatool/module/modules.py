"""The product of a factory as torch modules in evaluation mode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require, suggest
from vlatool.files.printable import amount


def modules_of(product: Any, graphs: Iterable[str]) -> dict[str, Any]:
    """Return the modules that a program runs: graph name -> torch module in evaluation mode.

    Args:
        product: a module, a program of ``torch.export``, or a mapping of graph names to them.

    Raises:
        SourceError: when one is missing or is something else.
    """
    torch = require("torch", "build")
    products = product if isinstance(product, Mapping) else {"main": product}
    modules = {}
    for name in dict.fromkeys(graphs):
        if name not in products:
            raise SourceError(
                f"The program runs '{name}', which the factory does not give; {suggest(name, products)}.",
                "name the graphs of the program as make() names its modules",
            )
        module = products[name]
        if isinstance(module, torch.export.ExportedProgram):
            module = module.module()
        if not isinstance(module, torch.nn.Module):
            raise SourceError(
                f"The factory gave a {type(module).__name__} for '{name}'; wanted a torch module.",
                "return a torch.nn.Module, or a dict of them: graph name -> module",
            )
        modules[name] = _in_eval_mode(module)
    return modules


def outputs_of(result: Any, step: ProgramStep) -> list[Any]:
    """Return what a module gave as a list, an entry per output of its step; raises SourceError for another number."""
    outputs = list(result) if isinstance(result, tuple | list) else [result]
    if len(outputs) != len(step.gives):
        raise SourceError(
            f"The module gives {amount(len(outputs), 'output')}; the program says {', '.join(step.gives)}.",
            "return as many tensors as the program's 'gives' names, in its order",
        )
    return outputs


def _in_eval_mode(module: Any) -> Any:
    """Put a module into evaluation mode; a part that torch.export made has the mode in which it was exported."""
    try:
        return module.eval()
    except NotImplementedError:
        for part in module.modules():
            part.training = False
        return module
