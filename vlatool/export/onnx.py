"""ONNX through torch's dynamo exporter, believed only after ONNX Runtime ran it."""

from __future__ import annotations

import ast
import contextlib
import io
import logging
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from vlatool.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import GraphError, SourceError, require, require_present
from vlatool.export._draws import refuse_draws
from vlatool.export._failures import export_error
from vlatool.export._norms import divide_by_roots
from vlatool.export._torch_policy import TorchSession, load_modules
from vlatool.finish import carry_over, finish
from vlatool.manifest import Graph, ProgramStep
from vlatool.runtime.contract import Outputs, check_chunk
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import Program
from vlatool.sources._factory import exits_told
from vlatool.sources._origin import factory_of
from vlatool.stage import Context, Transform, source_of

if TYPE_CHECKING:
    from torch import nn

    from vlatool.profile import Profile


EXTERNAL_DATA_BYTES = 1_500_000_000
"""Weights above this go into a file beside the graph: protobuf ends at 2 GiB."""


FOLDED = "vlatool.folded"
"""Key of a node's metadata: the module that was folded into it."""


class ExportOnnx(Transform):
    """Export every graph of a torch policy to ONNX (dynamo exporter, static shapes).

    The files count only after ONNX Runtime loaded them and gave, through the policy's whole program, what torch gives
    on calibration observations.
    """

    packages: ClassVar[tuple[str, ...]] = ("torch", "onnx", "onnxscript", "onnxruntime", "numpy")

    opset: int = Field(20, ge=18, le=23, description="opset of the default ONNX domain")
    samples: int = Field(8, ge=1, le=1024, description="observations on which torch and ONNX Runtime must agree")
    tolerance: float = Field(1e-3, gt=0, description="largest relative L2 difference between torch and ONNX Runtime")

    def runs(self, source: Bundle | None) -> str:
        """The factory builds the modules, and their forward() runs."""
        return factory_of(source)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """What exports is installed: the child process that imports it takes seconds to say so."""
        for module in ("torch", "onnxscript", "onnx"):
            require_present(module, "build")

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Export, run, compare, and write the bundle."""
        bundle = source_of(source, self.name())
        spec = bundle.manifest.spec
        check_chunk(spec)
        modules = load_modules(bundle)
        sessions = {step.graph: TorchSession(modules[step.graph], step) for step in bundle.manifest.program}
        observations = observations_for(bundle, self.samples)
        encode = ObservationEncoder(spec, bundle.path / "assets")
        context.tell("running the torch policy", None)
        torch_program = Program(bundle.manifest.program, sessions, seed=0)
        outputs = Outputs(spec.outputs)

        def action(values: dict[str, Any]) -> Any:
            return outputs(values, "The torch module")[spec.action.name]

        expected = [torch_program.run(encode(observation), finish=action) for observation in observations]
        graphs = {}
        for number, (name, session) in enumerate(sessions.items()):
            context.tell(f"exporting {name}", number / len(sessions))
            graphs[name] = self._export(name, session, out)
        carry_over(bundle, out)
        context.tell("checking in ONNX Runtime", None)
        made = finish(bundle, out, made_by=self.made_by(), graphs=graphs, observations=observations)
        self._compare(made, observations, expected)
        return made

    def _export(self, name: str, session: TorchSession, out: Path) -> Graph:
        torch = require("torch", "build")
        for module in ("onnxscript", "onnx"):
            require(module, "build")
        arguments = tuple(torch.from_numpy(np.ascontiguousarray(feed)) for feed in (session.first_feeds or {}).values())
        exported = exported_by_torch(session.module, arguments, session.step, self.opset)
        file = f"graphs/{name}.onnx"
        (out / "graphs").mkdir(exist_ok=True)
        name_by_module(exported.model)
        strip_notes(exported.model)
        exported.save(str(out / file), external_data=_weight_bytes(session.module) > EXTERNAL_DATA_BYTES)
        return Graph(file, {"float32": 1.0}, self.opset)

    def _compare(self, made: Bundle, observations: list[dict[str, Any]], expected: list[Any]) -> None:
        policy = Policy.open(made, threads=1, seed=0)
        for number, (observation, wanted) in enumerate(zip(observations, expected, strict=True)):
            got = policy.infer(observation).outputs[made.manifest.spec.action.name]
            error = relative_error(got, wanted)
            if not error <= self.tolerance:
                raise GraphError(
                    f"ONNX Runtime and torch differ on calibration sample {number}: relative L2 error {error:.3g}, "
                    f"allowed {self.tolerance:g}.",
                    "look for state that forward() keeps in its modules (declare it with 'keep' in the program), or "
                    "raise --tolerance if you know why",
                )


def exported_by_torch(module: Any, arguments: Sequence[Any], step: ProgramStep, opset: int, **options: Any) -> Any:
    """Export a module with torch's dynamo exporter; return its ``ONNXProgram``.

    Args:
        arguments: One tensor for each feed of the step, real or fake.
        options: For ``torch.onnx.export``.

    Raises:
        GraphError: when torch cannot, or the graph would draw random numbers.
    """
    torch = require("torch", "build")
    try:
        with quiet_exporter(), torch.no_grad(), exits_told("the policy's forward()"):
            exported = torch.onnx.export(
                module, tuple(arguments), dynamo=True, opset_version=opset, input_names=list(step.feeds),
                output_names=list(step.gives), verbose=False, **options,
            )  # fmt: skip
    except SourceError:
        raise
    except Exception as error:  # the seam: the exporter raises many foreign types
        raise_interrupt(error)
        raise export_error(error, step.graph, module) from error
    refuse_draws(exported.model, step.graph)
    divide_by_roots(exported.model)
    return exported


def raise_interrupt(error: BaseException | None) -> None:
    """Raise Ctrl-C again where a library has wrapped it into an error of its own."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        seen.add(id(error))
        error = error.__cause__ or error.__context__


def name_by_module(model: Any) -> None:
    """Name every node after the torch module that it comes from, so that globs can choose layers.

    ``blocks.0.mlp.fc1/MatMul``; a second node of that type in the module is ``blocks.0.mlp.fc1/MatMul_1``. What belongs
    to no module keeps the exporter's name. A layer with a normalisation folded in comes from the module that holds its
    weights; the normalisation's is noted beside it (``FOLDED``).
    """
    seen: Counter[str] = Counter()
    for node in model.graph.all_nodes():
        scopes = node.metadata_props.get("pkg.torch.onnx.name_scopes", "")
        found = ast.literal_eval(scopes) if scopes.startswith("[") else []
        if len(found) < 2 or not found[-2]:
            continue
        module = _folded_into(node) or found[-2]
        if module != found[-2]:
            node.metadata_props[FOLDED] = found[-2]
        base = f"{module}/{node.op_type}"
        node.name = base if not seen[base] else f"{base}_{seen[base]}"
        seen[base] += 1


def _folded_into(node: Any) -> str:
    """Return the module whose weights a node has that an exporter folded a BatchNorm into; nothing for others."""
    if "BatchNorm" not in node.metadata_props.get("pkg.onnxscript.rewriter.rule_name", ""):
        return ""
    weight = node.inputs[1].name if len(node.inputs) > 1 and node.inputs[1] is not None else ""
    return weight.removesuffix(".weight") if weight.endswith(".weight") else ""


def strip_notes(model: Any) -> None:
    """Remove what an exporter notes beside the graph (stack traces with file paths): it would leak and differ."""
    graphs = [model.graph, *(function.graph for function in model.functions.values())]
    model.metadata_props.clear()
    for graph in graphs:
        graph.metadata_props.clear()
        graph.doc_string = None
        values = [*graph.inputs, *graph.outputs, *graph.initializers.values()]
        for node in graph.all_nodes():
            folded = node.metadata_props.get(FOLDED)
            node.metadata_props.clear()
            if folded:
                node.metadata_props[FOLDED] = folded
            node.doc_string = None
            values.extend(node.outputs)
        for value in values:
            value.metadata_props.clear()
            value.doc_string = None


def _weight_bytes(module: nn.Module) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in [*module.parameters(), *module.buffers()])


@contextlib.contextmanager
def quiet_exporter() -> Iterator[None]:
    """Keep the exporter's progress prints, log lines and warnings away from the user's terminal."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    nowhere = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere), warnings.catch_warnings()
        ):  # fmt: skip
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
