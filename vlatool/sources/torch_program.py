"""A policy that torch.export.save wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require
from vlatool.files.printable import message_of, one_line
from vlatool.module.folding import fold_weights
from vlatool.module.to_onnx import OPSET, exported_by_torch, name_by_module, strip_notes
from vlatool.registry import Claim
from vlatool.sources._torch_archive import Kind
from vlatool.sources._torch_file import OpenedModule, TorchFile, example, is_file_of, path_names, rename_ends


class TorchProgram(TorchFile):
    """A policy that torch.export.save wrote, with static or dynamic shapes; opened in a child, where trusted."""

    needs: ClassVar[str] = "a program of torch.export (.pt2)"
    holds: ClassVar[Kind] = Kind.PROGRAM

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim .pt2 files."""
        return Claim.CERTAIN if is_file_of(Path(typed), (".pt2",)) else Claim.NONE

    def open_module(self, declared: Mapping[str, tuple[tuple[int | str, ...], str]]) -> OpenedModule:
        """Open the file; it says names, shapes and dtypes, and which axes are free."""
        torch = require("torch", "build")
        try:
            program = torch.export.load(str(self.model))
        except Exception as error:  # the seam: torch raises many foreign types
            reason = one_line(message_of(error).splitlines()[0] if message_of(error) else type(error).__name__, 200)
            raise SourceError(f"torch cannot open {self.model}: {reason}.", "save it again with this torch") from error
        leaves, spec = program.graph_signature.user_inputs, program.call_spec.in_spec
        values = {node.name: node.meta.get("val") for node in program.graph.nodes if node.op == "placeholder"}
        paths, _ = torch.utils._pytree.tree_flatten_with_path(
            torch.utils._pytree.tree_unflatten(list(range(len(leaves))), spec)
        )
        words = program.module_call_graph[0].signature.forward_arg_names or []
        places = [index for index, leaf in enumerate(leaves) if isinstance(values.get(leaf), torch.Tensor)]
        self._refuse_numbers(leaves, values)
        names = path_names([_with_word(paths[index][0], words) for index in places])
        axes = {name: _axes(values[leaves[index]]) for name, index in zip(names, places, strict=True)}
        shapes = {name: _shape(axes[name], declared[name][0] if name in declared else None) for name in names}

        def run(called: Any, *tensors: Any) -> Any:
            filled = list(leaves)
            for index, tensor in zip(places, tensors, strict=True):
                filled[index] = tensor
            arguments, keywords = torch.utils._pytree.tree_unflatten(filled, spec)
            return called(*arguments, **keywords)

        inputs = {
            name: example(shapes[name], str(values[leaves[index]].dtype).removeprefix("torch."))
            for name, index in zip(names, places, strict=True)
        }
        free = {name: {at: axis for at, axis in enumerate(axes[name]) if isinstance(axis, str)} for name in names}
        return OpenedModule(program.module(), run, inputs, free, program)

    def export_module(self, opened: OpenedModule, outputs: Sequence[str]) -> Any:
        """Translate it with torch's exporter, as a module of a policy is."""
        ir = require("onnx_ir", "build")
        step = ProgramStep(self.model.name, {}, {})
        exported = exported_by_torch(opened.program, (), step, self.opset or OPSET)
        fold_weights(exported.model)
        name_by_module(exported.model)
        strip_notes(exported.model)
        model = ir.to_proto(exported.model)
        rename_ends(model, list(opened.inputs), outputs)
        return model

    def _refuse_numbers(self, leaves: Sequence[Any], values: Mapping[str, Any]) -> None:
        torch = require("torch", "build")
        numbers = [leaf for leaf in leaves if isinstance(leaf, str) and not isinstance(values.get(leaf), torch.Tensor)]
        if numbers:
            raise SourceError(
                f"{self.model} takes numbers that are not tensors: {', '.join(map(str, numbers))}.",
                "let forward() take tensors, and export it again",
            )


def _with_word(path: Sequence[Any], words: Sequence[str]) -> list[Any]:
    """Return the path of an input behind the word of its argument, without the places in the call."""
    call, *rest = path[1:] if len(path) > 1 else path
    index = getattr(call, "idx", None)
    word = words[index] if index is not None and index < len(words) else getattr(call, "key", f"input_{index}")
    return [word, *rest]


def _axes(value: Any) -> list[int | str]:
    """Return the axes of a tensor of a program; a free one is named by its symbol."""
    return [axis if isinstance(axis, int) else str(axis) for axis in value.shape]


def _shape(axes: Sequence[int | str], declared: Sequence[int | str] | None) -> list[int | str]:
    """Return the shape of an example: what was declared, else a batch of one."""
    if declared is not None and len(declared) == len(axes):
        return list(declared)
    return [1 if index == 0 and isinstance(axis, str) else axis for index, axis in enumerate(axes)]
