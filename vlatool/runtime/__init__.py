"""What a robot controller imports: ``load`` a bundle, ``infer`` actions, ``reset``.

Needs numpy and one inference engine; never torch, onnx, pydantic, typer, rich or yaml.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard, overload

from vlatool.errors import refuse_two_distributions
from vlatool.runtime.arguments import check_load
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import Action
from vlatool.runtime.policy import FIRST_RUN_S, Policy, refuse_findings

if TYPE_CHECKING:
    from vlatool.bundle.spec import PolicySpec
    from vlatool.runtime.remote_policy import RemotePolicy
    from vlatool.runtime.stack import Fallback, Stack, Wrapper
    from vlatool.runtime.telemetry import Sink, Telemetry

__all__ = ["Action", "ChunkQueue", "Policy", "load"]
AUTO = "auto"
"""Name that stands for the engine that a bundle was made for."""
REMOTE_PREFIX, KEY_VARIABLE = "remote:", "VLATOOL_SERVE_KEY"
"""What stands before the URL of a policy of another machine; the environment variable with the key that it asks for."""


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
    controllers: Sequence[str] | None = ...,
    envelope: str | Wrapper | None = ...,
    deadline_ms: float | None = ...,
    fallback: Any = ...,
    telemetry: Sink | Telemetry | None = ...,
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
    controllers: Sequence[str] | None = None,
    envelope: str | Wrapper | None = None,
    deadline_ms: float | None = None,
    fallback: str | os.PathLike[str] | Fallback | Any = None,
    telemetry: Sink | Telemetry | None = None,
) -> Policy | Stack:
    """Load a bundle, verify it, open its graphs and warm them up.

    Args:
        path: The bundle directory.
        engine: Name of an engine, see ``vlatool doctor``; the one that the bundle was made for when empty or ``auto``.
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
        controllers, envelope, deadline_ms, fallback, telemetry: Layers around the policy (``stack.build_stack``); with
            any of them a ``Stack`` is returned. ``fallback`` may be the directory of a second bundle, too, or the URL
            of a policy that another machine serves (``remote:ws://HOST:PORT``). So may the path: then a ``Stack`` is
            returned, what is said of loading is for the fallback, and without one the server has to be there now.

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
    check_load(path, threads, seed, warmup, golden_tolerance, first_run_s, memory_mb)
    layers = {"controllers": controllers, "envelope": envelope, "deadline_ms": deadline_ms, "telemetry": telemetry}
    if is_remote(path):
        return _remote_stack(str(path), fallback, layers, engine=engine, threads=threads, seed=seed, warmup=warmup,
                             golden_tolerance=golden_tolerance, accept=accept, first_run_s=first_run_s,
                             memory_mb=memory_mb, probe=probe)  # fmt: skip
    engine = "" if engine == AUTO else engine
    bundle = Bundle.open_lazily(path)
    refuse_findings(bundle, accept)
    bundle.verify("data/")
    if probe:
        from vlatool.runtime.probe import probe as run_once

        run_once(bundle.path, engine=engine, threads=threads, first_run_s=first_run_s, memory_mb=memory_mb)
    policy = Policy.open(bundle, engine=engine, threads=threads, seed=seed, memory_mb=memory_mb)
    bundle.verify()
    policy.warm_up(warmup, golden_tolerance, first_run_s)
    if fallback is None and all(layer is None for layer in layers.values()):
        return policy
    if is_remote(fallback):
        fallback = open_remote(fallback, policy.spec)
    elif isinstance(fallback, str | os.PathLike):
        fallback = load(fallback, threads=threads, seed=seed, accept=accept)
    return _stack_of(policy, fallback=fallback, **layers)


def is_remote(path: Any) -> TypeGuard[str]:
    """Return whether a policy is named by a URL, ``remote:ws://HOST:PORT``, not by a directory.

    Example:
        >>> is_remote("remote:ws://10.0.0.5:8000"), is_remote("out/my-policy")
        (True, False)
    """
    return isinstance(path, str) and path.startswith(REMOTE_PREFIX)


def open_remote(url: str, spec: PolicySpec | None = None) -> RemotePolicy:
    """Return the policy that another machine serves, ``remote:ws://HOST:PORT``.

    The key that the server asks for is that of the environment variable ``VLATOOL_SERVE_KEY``.

    Args:
        spec: Of a policy with the same inputs and actions; with it, the server need not be there yet.

    Raises:
        ServingError, SpecError, UsageError, MissingExtra: as ``RemotePolicy`` does.
    """
    from vlatool.runtime.remote_policy import RemotePolicy

    return RemotePolicy(url.removeprefix(REMOTE_PREFIX), spec, key=os.environ.get(KEY_VARIABLE, ""))


def _remote_stack(url: str, fallback: Any, layers: dict[str, Any], **loading: Any) -> Stack:
    """Return the layers around a policy of another machine, with a local bundle, or none, to fall back to."""
    if isinstance(fallback, str | os.PathLike):
        fallback = load(fallback, **loading)
    second = fallback if hasattr(fallback, "spec") else getattr(fallback, "policy", None)
    return _stack_of(open_remote(url, getattr(second, "spec", None)), fallback=fallback, **layers)


def _stack_of(policy: Policy | RemotePolicy, **layers: Any) -> Stack:
    """Return the layers around a policy, in a process that is prepared for a deadline."""
    from vlatool.runtime.stack import build_stack, prepare_process

    if layers["deadline_ms"] is not None:
        prepare_process()
    return build_stack(policy, **{**layers, "controllers": layers["controllers"] or ()})
