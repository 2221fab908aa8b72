"""ONNX through torch's dynamo exporter, believed only after ONNX Runtime ran it."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import GraphError, RecipeError, SourceError, require, require_present
from vlatool.files.validate import short_repr
from vlatool.graph.float32_conversion import ROUNDING, describe_conversion, rewrite_as_float32
from vlatool.graph.loop_invariants import changing_feeds, compute_once, cut_loop_invariants, name_of_once
from vlatool.machine.engine_calls import engine_call
from vlatool.module.divergence import first_divergence
from vlatool.module.edits import is_changed
from vlatool.module.folding import fold_weights
from vlatool.module.memory import refuse_kept_values
from vlatool.module.sharded_weights import graph_weights, stored_modules, takes_shards, weights_on_demand
from vlatool.module.to_onnx import (
    EXTERNAL_DATA_BYTES,
    IMPORTS,
    OPSET,
    exported_by_torch,
    name_by_module,
    strip_notes,
    weight_bytes,
)
from vlatool.module.torch_policy import TorchSession, load_modules
from vlatool.runtime.contract import OF_NOT_FINITE, OF_THE_GRAPHS, OF_THE_POLICY, Outputs, check_chunk, off_the_robot
from vlatool.runtime.engine import engine_class
from vlatool.runtime.observation import ObservationEncoder, not_finite_text
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import Program
from vlatool.stage.base import Context, Result, Transform
from vlatool.stage.finish import carry_over, finish, graph_names
from vlatool.stage.precision_shares import count_shares
from vlatool.stage.record import made_by

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


LOWEST_OPSET = 18
"""Lowest opset of torch's dynamo exporter."""


class ExportOnnx(Transform):
    """Export every graph of a torch policy to ONNX (dynamo exporter, static shapes).

    The files are accepted only after ONNX Runtime has loaded them and, through the policy's whole program, given the
    same results as torch on calibration observations.
    """

    takes_modules: ClassVar[bool] = True
    packages: ClassVar[tuple[str, ...]] = ("torch", "onnx", "onnxscript", "onnxruntime", "numpy")
    imports: ClassVar[tuple[str, ...]] = IMPORTS

    opset: int = Field(OPSET, ge=7, le=23, description="opset of the default ONNX domain; of a torch policy from 18")
    shape: tuple[str, ...] = Field((), description="lengths of an ONNX file's free axes: NAME=1,3,224,224")
    samples: int = Field(8, ge=1, le=1024, description="observations on which torch and ONNX Runtime must agree")
    tolerance: float = Field(1e-3, gt=0, description="largest relative L2 difference between torch and ONNX Runtime")
    loop_invariants: bool = Field(True, description="compute once what is alike in all repeats of a graph")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """What exports is installed: the child process that imports it takes seconds to say so."""
        for module in ("torch", "onnxscript", "onnx"):
            require_present(module, "build")
        if self.opset < LOWEST_OPSET:
            raise RecipeError(
                f"opset = {self.opset}: torch exports opset {LOWEST_OPSET} and later.", "leave --opset out"
            )
        if self.shape:
            raise RecipeError(
                "--shape gives the free axes of an ONNX file their lengths; a torch policy has none.",
                "write the shapes into policy.yaml",
            )

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Export, run, compare, and write the bundle."""
        check_chunk(source.manifest.spec)
        observations = observations_for(source, self.samples)
        expected, graphs, program = self._run_and_export(source, observations, out, context)
        gone = {name: rewrite_as_float32(out / graph.file) for name, graph in graphs.items()}
        messages: tuple[str, ...] = ()
        for name, graph in graphs.items():
            shares, uncounted = count_shares(out / graph.file)
            graphs[name], messages = replace(graph, precision=shares), messages + uncounted
        carry_over(source, out)
        context.progress("checking in ONNX Runtime", None)
        changes = {"program": program}
        exported = finish(source, out, made_by=made_by(self), graphs=graphs, observations=observations, changes=changes)
        rounding = max((ROUNDING.get(kind, 0) for types in gone.values() for kind in types), default=0)
        error = self._compare(source, exported, observations, expected, max(self.tolerance, rounding))
        converted = (
            f"{name}: {describe_conversion(types)}; its action differs from torch's by up to {error:.2g}"
            for name, types in gone.items() if types
        )  # fmt: skip
        return Result(exported, (*messages, *converted))

    def _run_and_export(
        self, bundle: Bundle, observations: list[dict[str, Any]], out: Path, context: Context
    ) -> tuple[list[Any], dict[str, Graph], tuple[ProgramStep, ...]]:
        """Return what torch gives, the graphs, and the program that runs them; no module is in memory afterwards.

        A pruned policy whose weights stay in shards may be too large to be there as a whole: it runs with one weight at
        a time, and the weights of one graph are read to export it, which go into a file of their own.
        """
        stored = stored_modules(bundle) if is_changed(bundle) and takes_shards(bundle) else None
        modules = stored.modules if stored else load_modules(bundle)
        sessions = {step.graph: TorchSession(modules[step.graph], step) for step in bundle.manifest.program}
        context.progress("running the torch policy", None)
        with weights_on_demand(stored) if stored else contextlib.nullcontext():
            expected = self._actions(bundle, sessions, observations)
            for session in sessions.values():
                refuse_kept_values(session.module, session.step, session.last_feeds)
        graphs, program = dict[str, Graph](), bundle.manifest.program
        for number, (name, session) in enumerate(sessions.items()):
            context.progress(f"exporting {name}", number / len(sessions))
            with graph_weights(stored, name) if stored else contextlib.nullcontext():
                made, program = self._export(name, session, program, out, beside=stored is not None)
            graphs |= made
        return expected, graphs, program

    def _actions(
        self, bundle: Bundle, sessions: dict[str, TorchSession], observations: list[dict[str, Any]]
    ) -> list[Any]:
        """Return the raw action of each observation."""
        spec = bundle.manifest.spec
        encode, outputs = ObservationEncoder(spec, bundle.path / "assets"), Outputs(spec.outputs)
        program = Program(bundle.manifest.program, sessions, seed=0)

        def action(values: dict[str, Any]) -> Any:
            return outputs(values, "The torch module")[spec.action.name]

        def run(number: int, observation: dict[str, Any]) -> Any:
            encoded, held = encode(observation), not_finite_text(spec, observation)
            answered = f"observation {number}{f', which holds {held}' if held else ''}"
            try:
                with off_the_robot(answered, OF_NOT_FINITE if held else OF_THE_POLICY):
                    return program.run(encoded, finish=action)
            except SourceError as error:
                texts = [f"{name} {short_repr(value)}" for name, value in observation.items() if isinstance(value, str)]
                asked = f" The policy was asked with {', '.join(texts)}." if texts else ""
                raise SourceError(error.message + asked, error.fix) from error

        return [run(number, observation) for number, observation in enumerate(observations)]

    def _export(
        self, name: str, session: TorchSession, program: tuple[ProgramStep, ...], out: Path, beside: bool
    ) -> tuple[dict[str, Graph], tuple[ProgramStep, ...]]:
        """Write a graph, and one of what it would compute anew in each repeat; return both, and the program."""
        torch = require("torch", "build")
        for module in ("onnxscript", "onnx"):
            require(module, "build")
        feeds = [np.asarray(feed, order="C") for feed in (session.first_feeds or {}).values()]
        arguments = tuple(map(torch.from_numpy, feeds))
        exported = exported_by_torch(session.module, arguments, session.step, self.opset)
        (out / "graphs").mkdir(exist_ok=True)
        fold_weights(exported.model)
        name_by_module(exported.model)
        strip_notes(exported.model)
        beside = beside or weight_bytes(session.module) > EXTERNAL_DATA_BYTES
        graphs = {name: Graph(f"graphs/{name}.onnx", {"float32": 1.0}, self.opset)}
        changing = changing_feeds(program, name) if self.loop_invariants else None
        cut = None if changing is None else cut_loop_invariants(exported.model, changing)
        if cut is not None:
            once = name_of_once(program, name)
            graphs[once] = replace(graphs[name], file=f"graphs/{once}.onnx")
            program = compute_once(program, name, once, cut)
            require("onnx_ir", "build").save(
                cut.model, str(out / graphs[once].file), external_data=f"{once}.onnx.data" if beside else None
            )
        exported.save(str(out / graphs[name].file), external_data=beside)
        return graphs, program

    def _compare(
        self, source: Bundle, exported: Bundle, observations: list[dict[str, Any]], expected: list[Any],
        tolerance: float,
    ) -> float:  # fmt: skip
        """Return the largest difference from what torch gives."""
        largest = 0.0
        policy = Policy.open(exported, threads=1, seed=0)
        for number, (observation, reference) in enumerate(zip(observations, expected, strict=True)):
            doing = engine_call(engine_class(policy.engine), f"ran {graph_names(exported.manifest)}")
            with doing, off_the_robot(f"observation {number}", OF_THE_GRAPHS):
                got = policy.infer(observation).outputs[exported.manifest.spec.action.name]
            error = relative_error(got, reference)
            largest = max(largest, error)
            if not error <= tolerance:
                raise GraphError(
                    f"ONNX Runtime and torch differ on calibration sample {number}: relative L2 error {error:.3g}, "
                    f"allowed {tolerance:g}{self._place(source, exported, observation, tolerance)}.",
                    "look for state that forward() keeps in its modules (declare it with 'keep' in the program), or "
                    "raise --tolerance if you know why",
                )
        return largest

    def _place(self, source: Bundle, exported: Bundle, observation: dict[str, Any], tolerance: float) -> str:
        """Return in words from which node on the graphs differ; nothing where that is not found."""
        if is_changed(source) and takes_shards(source):
            return ""
        modules = load_modules(source)
        sessions = {step.graph: TorchSession(modules[step.graph], step) for step in source.manifest.program}
        self._actions(source, sessions, [observation])
        files = {name: exported.path / graph.file for name, graph in exported.manifest.graphs.items()}
        order = [step.graph for step in exported.manifest.program]
        for name, session in sessions.items():
            before = [files[once] for once in order[: order.index(name)][-1:] if once not in sessions]
            if node := first_divergence(session.module, files[name], session.first_feeds or {}, tolerance, before):
                return f"; they differ from the node '{node}' of the graph '{name}' on"
        return ""
