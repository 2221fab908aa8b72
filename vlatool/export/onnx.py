"""ONNX through torch's exporters, believed only after ONNX Runtime ran it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for, synthetic_observations
from vlatool.errors import GraphError, RecipeError, SourceError, VlatoolError, require, require_present
from vlatool.files.validate import short_repr
from vlatool.graph.float32_conversion import ROUNDING, describe_conversion, rewrite_as_float32
from vlatool.graph.loop_invariants import changing_feeds, compute_once, cut_loop_invariants, name_of_once
from vlatool.graph.opsets import fit_file
from vlatool.machine.engine_calls import engine_call
from vlatool.module.divergence import first_divergence
from vlatool.module.edits import is_changed
from vlatool.module.exporters import EXPORTERS
from vlatool.module.memory import refuse_kept_values
from vlatool.module.proven_export import WHERE_DIFFERENT, CalledSession, proven_export
from vlatool.module.sharded_weights import graph_weights, stored_modules, takes_shards, weights_on_demand
from vlatool.module.to_onnx import (
    IMPORTS,
    OPSET,
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
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile


BESIDE_BYTES = 256_000_000
"""Weights above this go into a file beside the graph, which engines map: OpenVINO holds those in a graph twice. A graph
ends at protobuf's 2 GiB anyway."""
LOWEST_OPSET = 18
"""Lowest opset of torch's dynamo exporter; graphs are written in an older one afterwards."""
RANDOM_OBSERVATIONS = 4
"""Random observations on which each graph is compared with its module, beside the recorded ones."""
RANDOM_SEED = 1


class ExportOnnx(Transform):
    """Export every graph of a torch policy to ONNX (static shapes).

    torch's exporters are tried in turn: dynamo; split, which records what forward() does between its modules and
    exports these with dynamo; the legacy one; and a trace. A graph is accepted only after ONNX Runtime has loaded it
    and given the same outputs as torch on recorded and random inputs, and the bundle only after that of its whole
    program on calibration observations.
    """

    takes_modules: ClassVar[bool] = True
    packages: ClassVar[tuple[str, ...]] = ("torch", "onnx", "onnxscript", "onnxruntime", "numpy")
    imports: ClassVar[tuple[str, ...]] = IMPORTS

    opset: int = Field(
        OPSET, ge=7, le=23, description="opset of the default ONNX domain; what torch exports is lowered below 18"
    )
    shape: tuple[str, ...] = Field((), description="lengths of an ONNX file's free axes: NAME=1,3,224,224")
    samples: int = Field(8, ge=1, le=1024, description="observations on which torch and ONNX Runtime must agree")
    tolerance: float = Field(1e-3, gt=0, description="largest relative L2 difference between torch and ONNX Runtime")
    exporter: Literal["auto", "dynamo", "split", "legacy", "trace"] = Field(
        "auto", description="exporter of torch; auto: the first whose graphs give what torch gives"
    )
    loop_invariants: bool = Field(True, description="compute once what is alike in all repeats of a graph")

    def on(self, board: Profile | None) -> Self:
        """Return the stage with an opset that the board's preferred engine takes, where the default is too new."""
        limit = board.engines[board.engine].opset if board else None
        return self.unless_given({"opset": int(limit.value)} if limit and limit.value < OPSET else {})

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """What exports is installed: the child process that imports it takes seconds to say so."""
        for module in ("torch", "onnxscript", "onnx"):
            require_present(module, "build")
        if self.shape:
            raise RecipeError(
                "--shape gives the free axes of an ONNX file their lengths; a torch policy has none.",
                "write the shapes into policy.yaml",
            )

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Export, run, compare, and write the bundle."""
        check_chunk(source.manifest.spec)
        observations = observations_for(source, self.samples)
        expected, graphs, program, notes = self._run_and_export(source, observations, out, context)
        gone = {name: rewrite_as_float32(out / graph.file) for name, graph in graphs.items()}
        messages = notes
        for name, graph in graphs.items():
            fit_file(out / graph.file, self.opset, None)
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
    ) -> tuple[list[Any], dict[str, Graph], tuple[ProgramStep, ...], tuple[str, ...]]:
        """Return what torch gives, the graphs, the program that runs them, and notes; no module is in memory then.

        A pruned policy whose weights stay in shards may be too large to be there as a whole: it runs with one weight at
        a time, and the weights of one graph are read to export it, which go into a file of their own.
        """
        stored = stored_modules(bundle) if is_changed(bundle) and takes_shards(bundle) else None
        modules = stored.modules if stored else load_modules(bundle)
        sessions = {step.graph: CalledSession(modules[step.graph], step) for step in bundle.manifest.program}
        context.progress("running the torch policy", None)
        with weights_on_demand(stored) if stored else contextlib.nullcontext():
            expected = self._actions(bundle, sessions, observations)
            for session in sessions.values():
                refuse_kept_values(session.module, session.step, session.last_feeds)
            with contextlib.suppress(VlatoolError):  # what the policy does not answer is not compared
                self._actions(bundle, sessions, synthetic_observations(bundle, RANDOM_OBSERVATIONS, RANDOM_SEED))
        graphs, program, notes = dict[str, Graph](), bundle.manifest.program, tuple[str, ...]()
        for number, (name, session) in enumerate(sessions.items()):
            context.progress(f"exporting {name}", number / len(sessions))
            with graph_weights(stored, name) if stored else contextlib.nullcontext():
                made, program, said = self._export(name, session, program, out, beside=stored is not None)
            graphs, notes = graphs | made, (*notes, *said)
        return expected, graphs, program, notes

    def _actions(
        self, bundle: Bundle, sessions: Mapping[str, TorchSession], observations: list[dict[str, Any]]
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
        self, name: str, session: CalledSession, program: tuple[ProgramStep, ...], out: Path, beside: bool
    ) -> tuple[dict[str, Graph], tuple[ProgramStep, ...], tuple[str, ...]]:
        """Write a graph, and one of what it would compute anew in each repeat; return both, the program, and notes."""
        torch, ir = require("torch", "build"), require("onnx_ir", "build")
        for module in ("onnxscript", "onnx"):
            require(module, "build")
        feeds = [np.asarray(feed, order="C") for feed in (session.first_feeds or {}).values()]
        arguments = tuple(map(torch.from_numpy, feeds))
        exporters = tuple(EXPORTERS) if self.exporter == "auto" else (self.exporter,)
        exported = proven_export(session, arguments, max(self.opset, LOWEST_OPSET), self.tolerance, exporters)
        (out / "graphs").mkdir(exist_ok=True)
        beside = beside or weight_bytes(session.module) > BESIDE_BYTES
        graphs = {name: Graph(f"graphs/{name}.onnx", {"float32": 1.0}, self.opset)}
        changing = changing_feeds(program, name) if self.loop_invariants else None
        cut = None if changing is None else cut_loop_invariants(exported.model, changing)
        if cut is not None:
            once = name_of_once(program, name)
            graphs[once] = replace(graphs[name], file=f"graphs/{once}.onnx")
            program = compute_once(program, name, once, cut)
            ir.save(cut.model, str(out / graphs[once].file), external_data=f"{once}.onnx.data" if beside else None)
        data = f"{name}.onnx.data" if beside else None
        ir.save(exported.model, str(out / graphs[name].file), external_data=data)
        return graphs, program, exported.notes(name, len(session.calls))

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
                    WHERE_DIFFERENT,
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
