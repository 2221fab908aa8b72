"""Weights that were trained elsewhere, instead of the policy's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError, suggest
from vlatool.files.printable import amount
from vlatool.module.edits import load_tensors, read_tensors
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile


class Weights(ModuleStage):
    """Replace a policy's weights by those of a safetensors file, such as a fine-tuned or distilled student's.

    Tensors are named as in ``state_dict()``, with ``GRAPH.`` before that where a policy has several graphs. The
    structure stays: that of the factory, or what pruning left of it.
    """

    file: Path = Field(description="safetensors file with every weight")

    def inputs(self) -> tuple[Path, ...]:
        """The file."""
        return (self.file,)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The file is there."""
        if not self.file.is_file():
            raise SourceError(f"No such file: {self.file}.", "check the path of the state_dict")
        super().check(source, profile)

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Load the weights.

        Raises:
            SourceError: when the file is not safetensors, or a tensor is missing, unknown, there twice, or has another
                shape or kind of numbers.
        """
        stored = read_tensors(self.file)
        check_tensors(modules, stored, str(self.file))
        for graph, module in modules.items():
            context.progress(f"loading the weights of {graph}", None)
            load_tensors(graph, module, stored, str(self.file))
        return ModuleChanges()


def check_tensors(modules: Mapping[str, nn.Module], stored: Mapping[str, Any], where: str) -> None:
    """See that a file holds the weights of modules and nothing else.

    Args:
        stored: name -> tensor; a name may have that of the graph before it.

    Raises:
        SourceError: when a tensor is unknown, there under both names, or of other numbers than the module's: codes of
            a quantized file or complex numbers are not weights, whatever their shape.
    """
    held = {graph: module.state_dict() for graph, module in modules.items()}
    known = {name: value for state in held.values() for name, value in state.items()}
    prefixed = {f"{graph}.{name}": value for graph, state in held.items() for name, value in state.items()}
    unknown = [name for name in stored if name not in known and name not in prefixed]
    if any("lora_" in name for name in unknown):
        raise SourceError(
            f"{where} holds adapters beside the weights: '{unknown[0]}' and {len(unknown) - 1} others.",
            "merge the adapters first, with PEFT: model.merge_and_unload(), and save the result",
        )
    if unknown:
        raise SourceError(
            f"{where} holds {amount(len(unknown), 'tensor')} that the policy has not: '{unknown[0]}'; "
            f"{suggest(unknown[0], known)}.",
            "save the state_dict() of the policy's own modules, and nothing else",
        )
    for graph, state in held.items():
        for name in state:
            if name in stored and f"{graph}.{name}" in stored:
                raise SourceError(f"{where} holds '{name}' twice, also as '{graph}.{name}'.", "keep one of them")
    for name, tensor in stored.items():
        wanted = known[name] if name in known else prefixed[name]
        if (tensor.is_floating_point(), tensor.is_complex()) != (wanted.is_floating_point(), wanted.is_complex()):
            got, want = (str(each.dtype).removeprefix("torch.") for each in (tensor, wanted))
            raise SourceError(
                f"'{name}' is {got} in {where}; the module's is {want}.",
                "save the weights as floating point numbers: dequantize() them first if they are codes",
            )
