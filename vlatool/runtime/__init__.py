"""What a robot controller imports: ``load`` a bundle, ``infer`` actions, ``reset``.

Needs numpy and one inference engine; never torch, onnx, pydantic, typer, rich or yaml.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, overload

from vlatool.errors import refuse_two_distributions
from vlatool.runtime.arguments import check_load
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import Action
from vlatool.runtime.loading import Layers, Loading, is_remote, open_policy, open_stack
from vlatool.runtime.policy import FIRST_RUN_S, Policy

if TYPE_CHECKING:
    from vlatool.runtime.stack import Fallback, Stack, Wrapper
    from vlatool.runtime.telemetry import Sink, Telemetry

__all__ = ["Action", "ChunkQueue", "Policy", "load"]


@overload
def load(
    path: str | os.PathLike[str],
    *,
    engine: str = ...,
    threads: int | None = ...,
    seed: int | None = ...,
    warmup: int = ...,
    golden_tolerance: float | None = ...,
    accept: Iterable[str] = ...,
    first_run_s: float = ...,
    memory_mb: float | None = ...,
    probe: bool = ...,
    engine_proof: str = ...,
) -> Policy: ...


@overload
def load(
    path: str | os.PathLike[str],
    *,
    engine: str = ...,
    threads: int | None = ...,
    seed: int | None = ...,
    warmup: int = ...,
    golden_tolerance: float | None = ...,
    accept: Iterable[str] = ...,
    first_run_s: float = ...,
    memory_mb: float | None = ...,
    probe: bool = ...,
    engine_proof: str = ...,
    controllers: Sequence[str] | None = ...,
    envelope: str | Wrapper | None = ...,
    deadline_ms: float | None = ...,
    fallback: Any = ...,
    telemetry: Sink | Telemetry | None = ...,
    record: str | os.PathLike[str] | None = ...,
) -> Policy | Stack: ...


def load(
    path: str | os.PathLike[str],
    *,
    engine: str = "",
    threads: int | None = None,
    seed: int | None = None,
    warmup: int = 2,
    golden_tolerance: float | None = None,
    accept: Iterable[str] = (),
    first_run_s: float = FIRST_RUN_S,
    memory_mb: float | None = None,
    probe: bool = False,
    engine_proof: str = "",
    controllers: Sequence[str] | None = None,
    envelope: str | Wrapper | None = None,
    deadline_ms: float | None = None,
    fallback: str | os.PathLike[str] | Fallback | Any = None,
    telemetry: Sink | Telemetry | None = None,
    record: str | os.PathLike[str] | None = None,
) -> Policy | Stack:
    """Load a bundle, verify it, open its graphs and warm them up.

    Args:
        path: The bundle directory.
        engine: Name of an engine, see ``vlatool doctor``; the one that the bundle was made for when empty. ``auto`` is
            that one, too, and where it cannot be used here the first one that can, with a warning;
            ``Policy.engine_reason`` says why.
        threads: Intra-op threads of the engine; the cores that this process may use when None.
        seed: Seed of the noise that a program draws; fresh entropy when None.
        warmup: Inferences on the golden observation before this returns (the first is the slowest).
        golden_tolerance: Largest relative L2 difference between the recorded golden action and this machine's, as the
            graphs give it and in physical units; what was measured of each when the bundle was made when None.
        accept: Names of findings in the manifest that are overruled, see ``vlatool inspect``.
        first_run_s: Seconds that an inference of the warm-up may take before it is stopped. ONNX Runtime can only be
            stopped between two nodes: one that takes hours is waited for, by Ctrl-C as well. OpenVINO is not waited
            for, but may compute on until the process ends. The opening of a graph cannot be stopped.
        memory_mb: Most that inputs and outputs of a graph may declare, and that the probe may take, in 10^6 bytes;
            2,000 and eight times the size of the graphs when None.
        probe: Do the first run in a child process, limited in time and memory, before this process opens a graph: for
            bundles of others. Whatever the child does, it is killed after ``first_run_s`` and 60 s for its start. Takes
            as long as loading twice and starting Python.
        engine_proof: ``record`` has the engine say in the warm-up what it runs of each graph, on what and in which
            precision (``Policy.engine_record``); ``warn`` also warns where that is not what the bundle promises, and
            ``require`` refuses it. This takes some milliseconds for a hundred nodes. When empty, only what an engine
            says by itself is looked at: its providers, devices and the dtype that it was asked for.
        controllers, envelope, deadline_ms, fallback, telemetry: Layers around the policy (``stack.build_stack``); with
            any of them a ``Stack`` is returned. ``fallback`` may be the directory of a second bundle, too, or the URL
            of a policy that another machine serves (``remote:ws://HOST:PORT``). So may the path: then a ``Stack`` is
            returned, what is said of loading is for the fallback, and without one the server has to be there now.
        record: New file in which each control step of the ``Stack`` is recorded, so that ``vlatool replay`` computes it
            again. Without a ``seed`` one is drawn, and recorded.

    Raises:
        BundleError: the directory is missing, incomplete, changed or too new.
        SpecError: normalisation statistics or a tokenizer are missing or do not fit.
        GraphError: the engine refuses a graph, the graph does not take and give what the spec declares, it computes
            something else than the graph says, a stage found the bundle to be wrong, or a limit is reached.
        UsageError: an argument is invalid.
        MissingExtra: the engine is not installed.
        InstallationError: vlatool and vlatool-runtime are installed side by side.
    """
    refuse_two_distributions()
    check_load(path, threads, seed, warmup, golden_tolerance, first_run_s, memory_mb, engine_proof)
    loading = Loading(
        engine, threads, seed, warmup, golden_tolerance, accept, first_run_s, memory_mb, probe, engine_proof
    )
    layers = Layers(controllers, envelope, deadline_ms, fallback, telemetry, record)
    if is_remote(path) or any(layer is not None for layer in layers):
        return open_stack(path, loading, layers)
    return open_policy(path, loading)
