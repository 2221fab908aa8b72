"""Weights that were trained elsewhere, instead of the policy's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.module.edits import load_tensors, read_tensors
from vlatool.module.stage import Changed, ModuleStage
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
            raise SourceError(f"No such file: {self.file}.")
        super().check(source, profile)

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> Changed:
        """Load the weights.

        Raises:
            SourceError: when the file is not safetensors, or a tensor is missing or has another shape.
        """
        stored = read_tensors(self.file)
        for graph, module in modules.items():
            context.tell(f"loading the weights of {graph}", None)
            load_tensors(graph, module, stored, str(self.file))
        return Changed()
