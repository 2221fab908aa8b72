"""A bundle whose graphs have an opset and an IR version that an engine takes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.export._same_actions import finish_rewritten, refuse_other_actions
from vlatool.graph.opsets import fit_file
from vlatool.stage.base import Context, Result, Transform, source_of

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile


class Opset(Transform):
    """Write the graphs of a bundle in an older opset or IR version, for an engine that takes no newer one.

    With --profile, in those that the board's preferred engine takes. What an older version lacks is refused by name,
    and the new graphs must give the actions of the old ones.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    opset: int | None = Field(None, ge=7, description="highest opset of the default ONNX domain")
    ir_version: int | None = Field(None, ge=3, description="highest version of the file format")

    def on(self, board: Profile | None) -> Self:
        """Return the stage with the versions that a board's preferred engine takes."""
        limits = board.engines[board.engine] if board else None
        if limits is None:
            return self
        known = {"opset": limits.opset, "ir_version": limits.ir_version}
        return self.unless_given({name: int(figure.value) for name, figure in known.items() if figure is not None})

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """A version is given, and there are graphs."""
        if self.opset is None and self.ir_version is None:
            raise RecipeError(
                "export opset needs an opset or an IR version.", "add --opset N, --ir-version N, or --profile BOARD"
            )
        source_of(source, self.name())

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Fit each graph, run the bundle, and compare its actions."""
        graphs, lowered = {}, []
        for name in source.manifest.files:
            if name.startswith("graphs/"):  # with external data; a copy, which is changed in place
                (out / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source.file(name), out / name)
        for name, graph in source.manifest.graphs.items():
            opset = fit_file(out / graph.file, self.opset, self.ir_version)
            lowered += [f"{name}: opset {graph.opset} -> {opset}"] if opset != graph.opset else []
            graphs[name] = replace(graph, opset=opset)
        made = finish_rewritten(self, source, out, graphs, context)
        refuse_other_actions(source, made)
        return Result(made, tuple(lowered) or ("the graphs are as old as that already",))
