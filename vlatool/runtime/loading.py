"""From the arguments of ``vlatool.load`` to a policy, and to the layers around it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

from vlatool.errors import UsageError
from vlatool.runtime.arguments import REQUIRE, WARN
from vlatool.runtime.policy import FIRST_RUN_S, Policy, refuse_findings

if TYPE_CHECKING:
    from vlatool.bundle.bundle import Bundle
    from vlatool.bundle.spec import PolicySpec
    from vlatool.runtime.remote_policy import RemotePolicy
    from vlatool.runtime.stack import Stack

AUTO = "auto"
"""Name that stands for the engine that a bundle was made for, or another where that cannot be used."""
REMOTE_PREFIX, KEY_VARIABLE = "remote:", "VLATOOL_SERVE_KEY"
"""What stands before the URL of a policy of another machine; the environment variable with the key that it asks for."""
OF_A_POLICY, OF_A_STACK = 4, 5
"""Levels from a warning here up to who called ``vlatool.load``, which loads a policy or a stack."""


class Loading(NamedTuple):
    """How a bundle is loaded: arguments of ``vlatool.load``."""

    engine: str = ""
    threads: int | None = None
    seed: int | None = None
    warmup: int = 2
    golden_tolerance: float | None = None
    accept: Iterable[str] = ()
    first_run_s: float = FIRST_RUN_S
    memory_mb: float | None = None
    probe: bool = False
    engine_proof: str = ""


class Layers(NamedTuple):
    """What is put around a policy: arguments of ``vlatool.load``, each None where it is not wanted."""

    controllers: Any = None
    envelope: Any = None
    deadline_ms: float | None = None
    fallback: Any = None
    telemetry: Any = None
    record: Any = None


def open_policy(path: str | os.PathLike[str], loading: Loading, level: int = OF_A_POLICY) -> Policy:
    """Load a bundle, with warnings at a level of the call stack; raises what ``vlatool.load`` raises."""
    from vlatool.bundle.bundle import Bundle

    bundle = Bundle.open_lazily(path)
    refuse_findings(bundle, loading.accept)
    engine, reason = _choose_engine(bundle, level) if loading.engine == AUTO else (loading.engine, "")
    bundle.verify("data/")
    threads, memory_mb = loading.threads, loading.memory_mb
    if loading.probe:
        from vlatool.runtime.probe import probe as run_once

        run_once(bundle.path, engine=engine, threads=threads, first_run_s=loading.first_run_s, memory_mb=memory_mb)
    traced = bool(loading.engine_proof)
    policy = Policy.open(bundle, engine=engine, threads=threads, seed=loading.seed, memory_mb=memory_mb, traced=traced)
    policy.engine_reason = reason
    bundle.verify()
    policy.warm_up(max(loading.warmup, traced), loading.golden_tolerance, loading.first_run_s)
    _check_engine_record(policy, loading.engine_proof, level)
    return policy


def open_stack(path: str | os.PathLike[str], loading: Loading, layers: Layers) -> Stack:
    """Load a bundle, or connect to a policy on another machine, and put layers around it; raises as ``open_policy``."""
    if is_remote(path):
        return _stack_around_remote(path, loading, layers)
    if loading.seed is None and layers.record is not None:
        loading = loading._replace(seed=int.from_bytes(os.urandom(4), "little"))
    policy = open_policy(path, loading, OF_A_STACK)
    second, identity = layers.fallback, ""
    if is_remote(second):
        _refuse_record(layers)
        second = open_remote(second, policy.spec)
    elif isinstance(second, str | os.PathLike):
        second = open_policy(second, Loading(threads=loading.threads, seed=loading.seed, accept=loading.accept,
                                             engine_proof=loading.engine_proof), OF_A_STACK)  # fmt: skip
        identity = second.identity
    given = layers._replace(fallback=second)
    if layers.record is None:
        return _build(policy, given)
    return _build_recorded(policy, given, threads=loading.threads, seed=loading.seed, second=identity)


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


def _stack_around_remote(url: str, loading: Loading, layers: Layers) -> Stack:
    """Return the layers around a policy of another machine, with a local bundle, or none, to fall back to."""
    _refuse_record(layers)
    fallback = layers.fallback
    if isinstance(fallback, str | os.PathLike):
        fallback = open_policy(fallback, loading, OF_A_STACK + 1)
    second = fallback if hasattr(fallback, "spec") else getattr(fallback, "policy", None)
    return _build(open_remote(url, getattr(second, "spec", None)), layers._replace(fallback=fallback))


def _refuse_record(layers: Layers) -> None:
    """Refuse to record a run with a policy that nobody can run again; raises UsageError."""
    if layers.record is not None:
        raise UsageError(
            "A policy on another machine cannot be recorded: nothing computes its actions again.",
            "leave record out, and let the other machine keep records: vlatool serve --records FILE",
        )


def _choose_engine(bundle: Bundle, level: int) -> tuple[str, str]:
    """Return the engine that ``auto`` stands for and why; warns where the bundle was made for another."""
    from vlatool.runtime.engine_choice import choose_engine

    choice = choose_engine(bundle.manifest)
    if choice.replaces:
        warnings.warn(f"engine='auto' is {choice.engine}: {choice.reason}", RuntimeWarning, stacklevel=level)
    return choice.engine, choice.reason


def _check_engine_record(policy: Policy, proof: str, level: int) -> None:
    """Warn of an engine that did not run as asked, or refuse it; see ``engine_proof`` of ``vlatool.load``."""
    if proof not in (WARN, REQUIRE):
        return
    record = policy.engine_record()
    if proof == REQUIRE:
        record.check()
    for problem in record.problems:
        warnings.warn(f"{record.library}: {problem}", RuntimeWarning, stacklevel=level)


def _build(policy: Policy | RemotePolicy, layers: Layers, **recording: Any) -> Stack:
    """Return the layers around a policy, in a process that is prepared for a deadline."""
    from vlatool.runtime.stack import build_stack, prepare_process

    if layers.deadline_ms is not None:
        prepare_process()
    return build_stack(policy, **_arguments(layers), **recording)


def _arguments(layers: Layers) -> dict[str, Any]:
    """Return the arguments of ``build_stack``."""
    given = layers._asdict()
    del given["record"]
    return {**given, "controllers": layers.controllers or ()}


def _build_recorded(policy: Policy, layers: Layers, **about: Any) -> Stack:
    """Return the layers around a policy, which are recorded; without a file when they make no sense."""
    from vlatool.runtime.stack import header_of
    from vlatool.runtime.telemetry.recorder import Recorder

    recorder = Recorder(layers.record)
    try:
        recorder.begin_run(header_of(policy, _arguments(layers), **about))
        return _build(policy, layers, recorder=recorder)
    except BaseException:
        recorder.close()
        os.unlink(layers.record)
        raise
