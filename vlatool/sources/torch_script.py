"""A policy that torch.jit.save wrote, scripted or traced."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from vlatool.errors import GraphError, SourceError, require
from vlatool.files.printable import message_of, one_line
from vlatool.module.to_onnx import quiet_exporter, raise_interrupt
from vlatool.registry import Claim
from vlatool.sources._torch_archive import Kind
from vlatool.sources._torch_file import (
    BUILD_IT,
    OpenedModule,
    TorchFile,
    example,
    free_axes,
    is_file_of,
    named_leaves,
    rename_ends,
)

ENDINGS = (".pt", ".pth", ".ckpt", ".ts", ".torchscript", ".jit")
OPSET = 20
"""Highest one of the exporter that takes TorchScript."""
MAPPINGS = ("Dict(str, Tensor)", "Dict[str, Tensor]")


class TorchScript(TorchFile):
    """A policy that torch.jit.save wrote, scripted or traced; opened in a child, where ``--trust FILE`` allowed it."""

    needs: ClassVar[str] = "a TorchScript file (.pt, .ts)"
    holds: ClassVar[Kind] = Kind.SCRIPT

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim files with the endings of torch."""
        return Claim.CERTAIN if is_file_of(Path(typed), ENDINGS) else Claim.NONE

    def open_module(self, declared: Mapping[str, tuple[tuple[int | str, ...], str]]) -> OpenedModule:
        """Open the file; a traced module says the shapes of its inputs, a scripted one does not."""
        torch = require("torch", "build")
        try:
            module = torch.jit.load(str(self.model), map_location="cpu", _restore_shapes=_is_traced(self.model)).eval()
        except Exception as error:  # the seam: torch raises many foreign types
            reason = one_line(message_of(error).splitlines()[0] if message_of(error) else type(error).__name__, 200)
            raise SourceError(f"torch cannot open {self.model}: {reason}.", "save it again with this torch") from error
        takes = self._takes(module)
        shapes = _traced(module, takes) | dict(declared)
        names = [name for name, kind in takes.items() if kind == "Tensor"]
        mapped = [name for name, kind in takes.items() if kind != "Tensor"]
        inner = [name for name in shapes if name not in names] if mapped else []
        self._refuse_unknown([*names, *inner], shapes, bool(mapped) and not inner)

        def run(called: Any, *tensors: Any) -> Any:
            given = dict(zip([*names, *inner], tensors, strict=True))
            return called(*({name: given[name] for name in inner} if name in mapped else given[name] for name in takes))

        inputs = {name: example(*shapes[name]) for name in (*names, *inner)}
        return OpenedModule(module, run, inputs, {name: free_axes(shapes[name][0]) for name in inputs})

    def export_module(self, opened: OpenedModule, outputs: Sequence[str]) -> Any:
        """Export it with the exporter of torch that takes TorchScript, control flow included."""
        torch, onnx = require("torch", "build"), require("onnx", "build")
        inputs = [f"in{number}" for number in range(len(opened.inputs))]
        given = [f"out{number}" for number in range(len(outputs))]

        class Flat(torch.nn.Module):  # type: ignore[misc,name-defined]
            def __init__(self) -> None:
                super().__init__()
                self.module = opened.module  # the tracer wants it to be a part

            def forward(self, *tensors: Any) -> Any:
                return tuple(named_leaves(opened.run(self.module, *tensors)).values())

        stream = io.BytesIO()
        free = {name: dict(opened.free[key]) for name, key in zip(inputs, opened.inputs, strict=True)}
        try:
            with quiet_exporter(), torch.no_grad():
                whole = torch.jit.trace(Flat().eval(), tuple(opened.inputs.values()), check_trace=False)
                torch.onnx.export(
                    whole, tuple(opened.inputs.values()), stream, dynamo=False, opset_version=OPSET,
                    input_names=inputs, output_names=given,
                    dynamic_axes={name: axes for name, axes in free.items() if axes},
                )  # fmt: skip
        except Exception as error:  # the seam: the exporter raises many foreign types
            raise_interrupt(error)
            raise GraphError(f"torch cannot export {self.model}: {_reason(error)}.", BUILD_IT) from error
        model = onnx.load_from_string(stream.getvalue())
        self._refuse_unread(model, inputs, list(opened.inputs))
        rename_ends(model, list(opened.inputs), outputs)
        return model

    def _takes(self, module: Any) -> dict[str, str]:
        """Return argument -> type of what forward() takes; arguments with a default keep it.

        Raises:
            SourceError: for a type that says neither how many tensors it holds nor their names.
        """
        takes = {
            argument.name: str(argument.type)
            for argument in module.forward.schema.arguments[1:]
            if not argument.has_default_value()
        }
        for name, kind in takes.items():
            if kind not in ("Tensor", *MAPPINGS) or sum(each in MAPPINGS for each in takes.values()) > 1:
                raise SourceError(
                    f"forward() in {self.model} takes '{name}' of the type {kind}; allowed: tensors, and one dict of "
                    "tensors by name.",
                    "wrap it in a module that takes them, script that, and save it",
                )
        return takes

    def _refuse_unknown(self, names: Sequence[str], shapes: Mapping[str, Any], nameless: bool) -> None:
        """Refuse inputs whose shapes nobody said: a scripted module takes any, and one that is made up decides much."""
        unknown = [name for name in names if name not in shapes]
        if unknown or nameless:
            options = " ".join(f"--shape {name}=1,AXIS" for name in unknown or ["NAME"])
            what = ", ".join(f"'{name}'" for name in unknown) if unknown else "the tensors that the dict holds"
            raise SourceError(
                f"{self.model} is scripted and does not say the shape of {what}.",
                f"say it once and keep it: vlatool new POLICY --from {self.model} {options} (numbers for AXIS; "
                "NAME=1,12:int64 for another dtype than float32); then name POLICY",
            )

    def _refuse_unread(self, model: Any, inputs: Sequence[str], names: Sequence[str]) -> None:
        kept = {value.name for value in model.graph.input}
        gone = [name for key, name in zip(inputs, names, strict=True) if key not in kept]
        if gone:
            raise SourceError(
                f"{self.model} takes {', '.join(gone)}, on which nothing that it returns depends.",
                "let forward() take what it uses, and save it again",
            )


def _is_traced(path: Path) -> bool:
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/traced_inputs.pkl") for name in archive.namelist())


def _traced(module: Any, takes: Mapping[str, str]) -> dict[str, tuple[tuple[int | str, ...], str]]:
    """Return input -> shape and dtype of a traced module, which keeps what it was traced with."""
    shapes: dict[str, tuple[tuple[int | str, ...], str]] = {}
    for value, name in zip([*module.forward.graph.inputs()][1:], takes, strict=False):
        kind = value.type()
        if kind.kind() == "TensorType" and kind.sizes() is not None and kind.dtype() is not None:
            shapes[name] = (tuple(kind.sizes()), str(kind.dtype()).removeprefix("torch."))
    return shapes


def _reason(error: BaseException) -> str:
    """Return what the exporter says, without the addresses of its documentation."""
    text = " ".join(message_of(error).split())
    return one_line(text.partition(" Please ")[0].partition("https://")[0].rstrip(" ."), 300)
