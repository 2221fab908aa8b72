"""What a robot controller imports: ``load`` a bundle, ``infer`` actions, ``reset``.

Needs numpy and one inference engine; never torch, onnx, pydantic, typer, rich or yaml.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, overload

from vlatool.errors import refuse_two_distributions
from vlatool.runtime.arguments import REQUIRE, WARN, check_load
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import Action
from vlatool.runtime.policy import FIRST_RUN_S, Policy, refuse_findings

if TYPE_CHECKING:
    from vlatool.bundle.bundle import Bundle
    from vlatool.runtime.stack import Fallback, Stack, Wrapper
    from vlatool.runtime.telemetry import Sink, Telemetry

__all__ = ["Action", "ChunkQueue", "Policy", "load"]
AUTO = "auto"
"""Name that stands for the engine that a bundle was made for, or another where that cannot be used."""


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
            any of them a ``Stack`` is returned. ``fallback`` may be the directory of a second bundle, too.
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
    from vlatool.bundle.bundle import Bundle

    refuse_two_distributions()
    check_load(path, threads, seed, warmup, golden_tolerance, first_run_s, memory_mb, engine_proof)
    bundle = Bundle.open_lazily(path)
    refuse_findings(bundle, accept)
    reason = ""
    if engine == AUTO:
        engine, reason = _chosen(bundle)
    bundle.verify("data/")
    if probe:
        from vlatool.runtime.probe import probe as run_once

        run_once(bundle.path, engine=engine, threads=threads, first_run_s=first_run_s, memory_mb=memory_mb)
    seed = _drawn_seed() if seed is None and record is not None else seed
    traced = bool(engine_proof)
    policy = Policy.open(bundle, engine=engine, threads=threads, seed=seed, memory_mb=memory_mb, traced=traced)
    policy.engine_reason = reason
    bundle.verify()
    policy.warm_up(max(warmup, traced), golden_tolerance, first_run_s)
    _check_record(policy, engine_proof)
    layers: dict[str, Any] = {
        "controllers": controllers,
        "envelope": envelope,
        "deadline_ms": deadline_ms,
        "telemetry": telemetry,
    }
    if fallback is None and record is None and all(layer is None for layer in layers.values()):
        return policy
    second = ""
    if isinstance(fallback, str | os.PathLike):
        fallback = load(fallback, threads=threads, seed=seed, accept=accept)
        second = fallback.identity if record is not None else ""
    given: dict[str, Any] = {**layers, "fallback": fallback, "controllers": controllers or ()}
    if record is None:
        return _stack_of(policy, given)
    return _recorded(policy, given, record, threads=threads, seed=seed, second=second)


def _chosen(bundle: Bundle) -> tuple[str, str]:
    """Return the engine that ``auto`` stands for and why; warns where the bundle was made for another."""
    from vlatool.runtime.engine_choice import choose_engine

    choice = choose_engine(bundle.manifest)
    if choice.replaces:
        warnings.warn(f"engine='auto' is {choice.engine}: {choice.reason}", RuntimeWarning, stacklevel=3)
    return choice.engine, choice.reason


def _check_record(policy: Policy, proof: str) -> None:
    """Warn of an engine that did not run as asked, or refuse it; see ``engine_proof`` of ``load``."""
    if proof not in (WARN, REQUIRE):
        return
    record = policy.engine_record()
    if proof == REQUIRE:
        record.check()
    for problem in record.problems:
        warnings.warn(f"{record.library}: {problem}", RuntimeWarning, stacklevel=3)


def _stack_of(policy: Policy, layers: dict[str, Any]) -> Stack:
    """Return the layers around a policy, in a process that is prepared for a deadline."""
    from vlatool.runtime.stack import build_stack, prepare_process

    if layers["deadline_ms"] is not None:
        prepare_process()
    return build_stack(policy, **layers)


def _recorded(policy: Policy, layers: dict[str, Any], path: Any, **about: Any) -> Stack:
    """Return the layers around a policy, which are recorded; without a file when they make no sense."""
    from vlatool.runtime.stack import header_of
    from vlatool.runtime.telemetry.recorder import Recorder

    recorder = Recorder(path)
    try:
        recorder.begin_run(header_of(policy, layers, **about))
        return _stack_of(policy, {**layers, "recorder": recorder})
    except BaseException:
        recorder.close()
        os.unlink(path)
        raise


def _drawn_seed() -> int:
    return int.from_bytes(os.urandom(4), "little")
